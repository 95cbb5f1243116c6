"""The `placewise` command, as people and scripts run it."""

from __future__ import annotations

import json
import re
import shlex
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.photos import exif_with_position, photo_bytes
from tests.support.server import CommandLine, Run, ServerProcess, environment, run_command

PHOTOS = 50  # from as many on, `index` fits a vocabulary
SETTINGS = {"extractor": "test-tiny-vlad"}

# Turin's Mole in UTM: 396878 m east, 4991561 m north in zone 32T is 45.07 N, 7.69 E.
UTM_SHORT = "@0396877.76@4991561.25@.jpg"
UTM_FULL = "@396877.76@4991561.25@32@T@@@pano@@123.5@@@@20260501@@.jpg"
UTM_WITH_DEGREES = "@396877.76@4991561.25@32@T@45.5@-7.25@pano@@@@@@@@.jpg"


@pytest.fixture
def placewise(server: ServerProcess, tmp_path: Path) -> CommandLine:
    """The command beside a running server, which it finds by PLACEWISE_HOME."""
    return CommandLine(tmp_path, server.home)


def with_gps(number: int) -> bytes:
    """A photo whose EXIF says 45 30' N, 7 15' E."""
    return photo_bytes(number, exif=exif_with_position(45.5, 7.25))


def coordinates(server: ServerProcess) -> dict[str, tuple[float | None, float | None]]:
    body = server.client.get("/api/v1/search", params={"limit": 1000}).json()
    return {
        image["original_filename"]: (image["latitude"], image["longitude"])
        for image in body["images"]
    }


@dataclass(slots=True)
class Indexed:
    """A folder that was indexed three times, first a part of it into a map without a vocabulary."""

    folder: Path
    without_fit: Run
    with_fit: Run
    without_the_broken: Run


@pytest.fixture(scope="module")
def indexed(server: ServerProcess, tmp_path_factory: pytest.TempPathFactory) -> Indexed:
    folder = tmp_path_factory.mktemp("photos")
    (folder / "below").mkdir()
    (folder / "notes.txt").write_text("no photo, and not looked at")
    (folder / "exif.jpg").write_bytes(with_gps(0))
    (folder / UTM_FULL).write_bytes(photo_bytes(1))
    (folder / UTM_SHORT).write_bytes(photo_bytes(3))
    (folder / UTM_WITH_DEGREES).write_bytes(photo_bytes(2))
    broken, cut_off = folder / "broken.jpg", folder / "cut-off.jpg"
    broken.write_bytes(b"Only text, named as a photo.")
    cut_off.write_bytes(photo_bytes(99)[:-60])  # its header is whole

    command = CommandLine(folder.parent, server.home)
    assert command("maps", "create", "pooled").code == 0
    index = ("index", folder, "--utm-zone", "32T")
    without_fit = command(*index, "--map", "pooled", "--no-fit", "--json")
    listed = command("maps", "list", "--json").json()
    assert {map_["name"]: map_["auto_fit"] for map_ in listed} == {"default": True, "pooled": False}
    assert command("maps", "delete", "pooled", "--yes").code == 0
    for number in range(4, PHOTOS):
        (folder / "below" / f"{number}.JPG").write_bytes(photo_bytes(number))
    with_fit = command(*index, "--json")
    broken.unlink()
    cut_off.unlink()
    return Indexed(folder, without_fit, with_fit, command(*index))


def test_index_uploads_a_folder_and_names_what_is_refused(indexed: Indexed) -> None:
    report = indexed.without_fit.json(code=1)
    assert (report["photos"], report["already_there"]) == (4 + 2, 0)
    assert [item["path"] for item in report["refused"]] == [str(indexed.folder / "broken.jpg")]
    assert "JPEG" in report["refused"][0]["reason"]
    assert report["fitted"] is None
    assert report["vocabulary"] == "pending"
    assert report["searchable"] == 4


def test_index_fits_a_vocabulary_from_fifty_photos_on(indexed: Indexed) -> None:
    report = indexed.with_fit.json(code=1)
    assert report["vocabulary"] == "own"
    assert report["fitted"]["state"] == "succeeded"
    assert report["searchable"] == PHOTOS
    assert [item["path"] for item in report["failed"]] == [str(indexed.folder / "cut-off.jpg")]
    assert report["failed"][0]["reason"]


def test_indexing_again_uploads_nothing(indexed: Indexed) -> None:
    again = indexed.without_the_broken
    assert again.code == 0, again.stderr
    assert f"{PHOTOS} photos processed, {PHOTOS} already stored" in again.stderr
    assert f"{PHOTOS} searchable" in again.stderr


def test_index_reads_places_from_exif_and_from_names(
    server: ServerProcess, indexed: Indexed
) -> None:
    found = coordinates(server)
    assert found["exif.jpg"] == pytest.approx((45.5, 7.25))
    assert found[UTM_FULL] == pytest.approx((45.07, 7.69), abs=1e-6)
    assert found[UTM_SHORT] == pytest.approx((45.07, 7.69), abs=1e-6)
    assert found[UTM_WITH_DEGREES] == (45.5, -7.25)
    assert found["4.JPG"] == (None, None)
    named = server.client.get("/api/v1/search", params={"filename": "4.JPG"}).json()["images"]
    paths = {image["original_filename"]: image["relative_path"] for image in named}
    assert paths["4.JPG"] == "below/4.JPG"  # 14.JPG is found, too
    assert (
        f"1 other file skipped (1 .txt), {PHOTOS - 4} photos without coordinates."
        in indexed.without_the_broken.stderr
    )
    headed = server.client.get("/api/v1/search", params={"filename": UTM_FULL}).json()["images"]
    assert headed[0]["heading"] == 123.5


@pytest.mark.usefixtures("indexed")
def test_query_finds_the_place(placewise: CommandLine, tmp_path: Path) -> None:
    photo = tmp_path / "where.jpg"
    photo.write_bytes(photo_bytes(2))
    answer = placewise("query", photo, "--top-k", "2", "--json").json()
    assert answer["query_filename"] == "where.jpg"
    assert answer["similar_images"][0]["original_filename"] == UTM_WITH_DEGREES
    assert answer["total_similar"] == 2
    strict = placewise("query", photo, "--min-score", "0.999", "--json").json()
    assert strict["total_similar"] == 1

    (tmp_path / "exif.jpg").write_bytes(with_gps(0))
    shown = placewise("query", tmp_path / "exif.jpg", "--top-k", "1")
    assert shown.code == 0
    for part in ("exif.jpg", "45.500000", "7.250000", "vocabulary: "):
        assert part in shown.stdout, part
    _, score, *_ = shown.stdout.splitlines()[1].split("\t")
    assert float(score) == pytest.approx(1, abs=2**-11), "the rows are float16"


def test_a_refusal_is_one_line_or_one_document(placewise: CommandLine, tmp_path: Path) -> None:
    text = tmp_path / "text.jpg"
    text.write_text("Only text, named as a photo.")
    assert "JPEG" in placewise("query", text, "--json").refusal("unsupported_photo")
    shown = placewise("query", text)
    assert (shown.code, shown.stdout) == (1, "")
    assert shown.stderr.startswith("unsupported_photo: ")
    assert shown.stderr.count("\n") == 1
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(photo_bytes(1))
    detail = placewise("query", photo, "--map", "nowhere", "--json").refusal("map_not_found")
    assert "nowhere" in detail

    with socket.create_server(("127.0.0.1", 0)) as closed_later:
        dead = f"http://127.0.0.1:{closed_later.getsockname()[1]}"
    for number in range(12):  # each tried for a minute, they would take longer than a command may
        (tmp_path / f"{number}.jpg").write_bytes(photo_bytes(number))
    for command in (("query", photo), ("index", tmp_path)):
        detail = placewise(*command, "--server", dead, "--json").refusal("server_unreachable")
        assert dead in detail
    assert placewise("query", tmp_path / "none.jpg").code == 2, "a usage error"


@pytest.mark.usefixtures("indexed")
def test_the_printed_command_reaches_this_server_from_another_folder(
    server: ServerProcess, tmp_path: Path
) -> None:
    [line] = re.findall(r"(PLACEWISE_HOME=.+) query PHOTO", server.log_path.read_text())
    variable, program = shlex.split(line)
    home = variable.removeprefix("PLACEWISE_HOME=")
    assert Path(program).is_absolute()
    (tmp_path / "where.jpg").write_bytes(photo_bytes(2))
    shown = CommandLine(tmp_path, Path(home))("query", tmp_path / "where.jpg", "--map", "default")
    assert "No server runs" not in shown.stderr
    assert f"Searched map default of {server.client.base_url}, which serves {server.home}" in (
        shown.stdout
    )


def test_commands_name_the_map_and_the_server_that_they_use(
    server: ServerProcess, indexed: Indexed, tmp_path: Path
) -> None:
    url = str(server.client.base_url)
    assert f"Indexing into map default of {url}" in indexed.without_the_broken.stderr
    home = shlex.quote(str(server.home))
    assert f"Next: PLACEWISE_HOME={home} " in indexed.without_the_broken.stderr
    elsewhere = CommandLine(tmp_path, tmp_path / "other home")
    assert elsewhere("maps", "create", "yard", "--server", url).code == 0
    (tmp_path / "one.jpg").write_bytes(photo_bytes(0))
    report = elsewhere("index", tmp_path / "one.jpg", "--map", "yard", "--server", url)
    assert f"Indexing into map yard of {url}\n" in report.stderr
    assert f"query PHOTO --map yard --server {url}\n" in report.stderr
    assert elsewhere("maps", "delete", "yard", "--yes", "--server", url).code == 0
    assert not (tmp_path / "other home").exists()


def test_commands_work_without_a_server(tmp_path: Path) -> None:
    alone = CommandLine(tmp_path, tmp_path / "home")
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(3):
        (photos / f"{number}.jpg").write_bytes(photo_bytes(number))
    indexed = alone("index", photos, "--json")
    assert f"No server runs on {tmp_path / 'home'}: starting one" in indexed.stderr
    report = indexed.json()
    assert (report["photos"], report["searchable"], report["vocabulary"]) == (3, 3, "none")
    answer = alone("query", photos / "1.jpg", "--json").json()
    assert answer["similar_images"][0]["original_filename"] == "1.jpg"
    assert answer["total_similar"] == 3
    assert not (tmp_path / "home" / "server.json").exists(), "the server ended with the command"


def test_a_command_that_describes_no_photo_never_imports_torch(tmp_path: Path) -> None:
    script = (
        "import sys\n"
        "from services.cli.main import run\n"
        "sys.argv = ['placewise', 'maps', 'list', '--json']\n"
        "try:\n"
        "    run()\n"
        "except SystemExit as ended:\n"
        "    assert not ended.code\n"
        "slow = {'torch', 'minio', 'psycopg'} & sys.modules.keys()\n"
        "assert not slow, slow\n"
    )
    env = environment(tmp_path / "home")
    ended = subprocess.run(
        [sys.executable, "-c", script], env=env, cwd=tmp_path, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    assert [row["name"] for row in json.loads(ended.stdout)] == ["default"]


def test_an_extractor_that_can_not_start_ends_only_what_needs_it(tmp_path: Path) -> None:
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(photo_bytes(0))
    # Hides the GPUs of this machine.
    env = {**environment(tmp_path / "home", device="cuda"), "CUDA_VISIBLE_DEVICES": ""}
    listed, indexed, served = (
        Run(run_command(*arguments, env=env, cwd=tmp_path))
        for arguments in (("maps", "list"), ("index", tmp_path, "--json"), ("serve",))
    )
    assert listed.code == 0, listed.stderr
    assert "DEVICE=cuda" in indexed.refusal("cuda_missing")
    assert served.code == 1
    assert "DEVICE=cuda" in served.stderr
    assert "Traceback" not in served.stderr


def test_config_shows_effective_settings_and_no_secret(tmp_path: Path) -> None:
    secret = "postgresql+psycopg://user:hidden-word@db.example/places"
    command = CommandLine(tmp_path, tmp_path / "home", database_url=secret, max_file_size=12345)
    as_json, as_table = command("config", "--json"), command("config")
    values = as_json.json()
    assert values["MAX_FILE_SIZE"] == 12345
    assert values["EXTRACTOR"] == "test-tiny-avg"
    assert values["PLACEWISE_HOME"] == str(tmp_path / "home")
    assert values["DATABASE_URL"], "it is set, and that can be seen"
    assert as_table.code == 0
    assert "MAX_FILE_SIZE" in as_table.stdout
    for run in (as_json, as_table):
        assert "hidden-word" not in run.stdout + run.stderr


@pytest.mark.usefixtures("indexed")
def test_doctor_finds_the_running_server(server: ServerProcess, placewise: CommandLine) -> None:
    findings = {finding["part"]: finding for finding in placewise("doctor", "--json").json()}
    assert set(findings) == {
        *("versions", "settings", "folder", "permissions", "device", "memory", "extractor"),
        *("server", "server catalog", "server object store", "server search"),
        *("server extractors", "server queue", "server uploads"),
    }
    assert all(finding["ok"] for finding in findings.values()), findings
    assert "1 in the map default" in findings["server extractors"]["detail"], "cut-off.jpg"
    assert str(server.client.base_url).rstrip("/") in findings["server"]["detail"]
    assert "test-tiny-avg" in findings["extractor"]["detail"]


def test_doctor_names_a_server_that_does_not_tell_its_health(
    placewise: CommandLine, server: ServerProcess
) -> None:
    elsewhere = f"{str(server.client.base_url).rstrip('/')}/elsewhere"
    for url, words in (
        ("http://127.0.0.1:1", "http://127.0.0.1:1 does not answer"),
        (elsewhere, f"{elsewhere} answers: "),
    ):
        findings = placewise("doctor", "--server", url, "--json").json(code=1)
        (found,) = [each for each in findings if each["part"] == "server"]
        assert not found["ok"]
        assert words in found["detail"]


def test_doctor_says_what_needs_attention(tmp_path: Path) -> None:
    settings = {"extractor": "anyloc-vits14", "dino_weights": tmp_path / "[gone].pth"}
    command = CommandLine(tmp_path, tmp_path / "home", **settings)
    findings = {f["part"]: f for f in command("doctor", "--json").json(code=1)}
    assert [part for part, finding in findings.items() if not finding["ok"]] == ["extractor"]
    assert "Three ways to get the weights of dinov2-vits14" in findings["extractor"]["detail"]
    assert "not running" in findings["server"]["detail"]
    assert findings["catalog file"]["detail"] == "nothing is stored yet"
    shown = command("doctor")
    assert shown.code == 1
    assert f"DINO_WEIGHTS={tmp_path}/[gone].pth does not exist" in shown.stdout


def test_doctor_says_which_setting_keeps_everything_else_from_starting(tmp_path: Path) -> None:
    command = CommandLine(tmp_path, tmp_path / "home", extractor="anylock-vitg14")
    (finding,) = command("doctor", "--json").json(code=1)
    assert (finding["part"], finding["ok"]) == ("settings", False)
    assert "EXTRACTOR=anylock-vitg14" in finding["detail"]
    assert "anyloc-vitg14" in finding["detail"]
