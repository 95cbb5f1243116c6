"""Webhooks: told what happened, signed, again until it was heard, and led nowhere else."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import update

from services.extractor.worker import ExtractorWorker
from services.steward import webhooks as send_module
from services.steward.batches.worker import BatchWorker
from services.steward.webhooks import (
    MAX_IN_FLIGHT,
    RETRY_DELAYS_SECONDS,
    WebhookDispatcher,
    retry_delay_seconds,
)
from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.webhooks import Delivery, EventKind, Webhook, enqueue_event
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups, Job, JobState
from shared.security.webhook_targets import WebhookTarget, parse_webhook_url
from shared.storage import FolderStore
from tests.integration.api_with_keys import ADMIN, Door
from tests.integration.steward.webhook_receiver import (
    Receiver,
    certificate,
    hanging_receiver,
    receiving,
)
from tests.integration.workplace import Workplace
from tests.support.archives import zip_of
from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, problem

PHOTOS = 6


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"webhook_private_addresses": True})


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with receiving() as made:
        yield made


class Told:
    """A service with a webhook at the receiver."""

    def __init__(
        self,
        door: Door,
        settings: Settings,
        receiver: Receiver,
        make_worker: Callable[[], ExtractorWorker],
    ) -> None:
        self.door, self.receiver, self._make_worker = door, receiver, make_worker
        self.sender = WebhookDispatcher(door.catalog, settings)
        self.webhook = self.add("job.succeeded", "job.failed")

    def add(self, *events: str) -> dict[str, Any]:
        params = {"url": self.receiver.url, "events": events}
        made = self.door(ADMIN, "POST", "/webhooks", json=params)
        assert made.status_code == 201, made.text
        answer: dict[str, Any] = made.json()
        return answer

    def send(self, sender: WebhookDispatcher | None = None) -> int:
        """Attempt what is due; how many deliveries that were."""
        one = sender or self.sender
        return sum(asyncio.run(one.deliver_due(webhook)) for webhook in one.due_webhooks())

    def trust(self, folder: Path, name: str) -> ssl.SSLContext:
        """For a server of that name, whose certificate our sender takes for a good one."""
        pem = certificate(folder, name)
        self.sender._tls.load_verify_locations(pem)
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        server.load_cert_chain(pem)
        return server

    def announce(self, event: EventKind) -> None:
        """An event that nothing but webhooks hears of."""
        with self.door.catalog.write() as session:
            enqueue_event(session, event, {})

    def photo(self, number: int = 1) -> dict[str, Any]:
        """One that was put in and described."""
        uploaded: dict[str, Any] = self.door.put(ADMIN, number).json()
        self._make_worker().drain(threading.Event())
        return uploaded

    def log(self, webhook: dict[str, Any] | None = None) -> list[dict[str, Any]]:
        webhook_id = (webhook or self.webhook)["id"]
        answer = self.door(ADMIN, "GET", f"/webhooks/{webhook_id}/deliveries")
        found: list[dict[str, Any]] = answer.json()["deliveries"]
        return found

    def come_due(self) -> None:
        with self.door.catalog.write() as session:
            session.execute(update(Delivery).values(next_attempt_at=db_now()))


@pytest.fixture
def told(
    door: Door, settings: Settings, receiver: Receiver, make_worker: Callable[[], ExtractorWorker]
) -> Told:
    return Told(door, settings, receiver, make_worker)


@pytest.fixture
def localhost_tls(told: Told, tmp_path: Path) -> ssl.SSLContext:
    return told.trust(tmp_path, "localhost")


def test_a_described_photo_is_told_of_and_signed(told: Told) -> None:
    uploaded = told.photo()
    assert told.send() == 1
    (message,) = told.receiver.messages
    assert message.path == "/hook?a=1"
    assert message.is_signed_with(told.webhook["secret"])
    body = message.json()
    assert body["type"] == "job.succeeded"
    assert body["data"]["job_id"] == uploaded["job_id"]
    assert body["data"]["file_id"] == uploaded["file_id"]
    assert (body["data"]["kind"], body["data"]["map"]) == ("index", "default")
    (delivery,) = told.log()
    assert (delivery["state"], delivery["attempts"], delivery["last_status"]) == (
        "delivered",
        1,
        204,
    )
    assert message.headers["webhook-id"] == f"msg_{delivery['event_id']}"
    assert told.send() == 0, "once it was heard, it is not told again"


def test_only_events_that_are_wanted_are_told_and_each_webhook_is_told_alone(told: Told) -> None:
    other, switches = told.add("job.succeeded"), told.add("generation.switched")
    told.photo()
    assert told.send() == 2
    ids = {message.headers["webhook-id"] for message in told.receiver.messages}
    assert len(ids) == 1, "one event"
    signed = [
        [message.is_signed_with(hook["secret"]) for hook in (told.webhook, other)]
        for message in told.receiver.messages
    ]
    assert sorted(signed) == [[False, True], [True, False]]
    assert told.log(switches) == []


def test_what_was_not_heard_is_told_again_later_under_the_same_id(told: Told) -> None:
    told.photo()
    told.receiver.status = 500
    assert told.send() == 1
    (waits,) = told.log()
    assert (waits["state"], waits["last_status"]) == ("pending", 500)
    assert waits["next_attempt_at"] is not None
    assert told.send() == 0, "not at once"
    told.come_due()
    told.receiver.status = 200
    assert told.send() == 1
    assert [entry["state"] for entry in told.log()] == ["delivered"]
    first, second = told.receiver.messages
    assert first.headers["webhook-id"] == second.headers["webhook-id"]
    assert first.body == second.body


def test_pauses_grow_for_three_days_and_then_it_is_given_up(told: Told) -> None:
    told.photo()
    told.receiver.status = 503
    for _ in range(len(RETRY_DELAYS_SECONDS)):
        assert told.send() == 1
        assert told.log()[0]["state"] == "pending"
        told.come_due()
    assert told.send() == 1
    assert told.log()[0]["state"] == "failed"
    told.come_due()
    assert told.send() == 0
    pauses = [retry_delay_seconds(attempts) for attempts in range(1, len(RETRY_DELAYS_SECONDS) + 1)]
    assert pauses == sorted(pauses, key=lambda pause: pause or 0)
    assert 2 * 86_400 < sum(pause or 0 for pause in pauses) < 5 * 86_400


def test_a_try_whose_steward_died_is_made_again(told: Told) -> None:
    told.photo()
    _, claimed = told.sender._claim_due(UUID(told.webhook["id"]))  # and then it dies
    assert len(claimed) == 1
    assert told.send() == 0, "another steward leaves it alone for a while"
    told.come_due()
    assert told.send() == 1
    assert told.log()[0]["attempts"] == 2


def test_a_redirect_is_not_followed(told: Told) -> None:
    with receiving() as inside:
        told.receiver.status = 302
        told.receiver.headers = {"Location": inside.url}
        told.photo()
        told.send()
        assert inside.messages == []
    (delivery,) = told.log()
    assert delivery["last_status"] == 302
    assert "redirects are not followed" in delivery["last_error"]


def test_a_name_that_has_become_private_since_is_not_called(
    told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As DNS rebinding does it: public when the webhook was made, loopback when it is called.
    told.photo()
    strict = WebhookDispatcher(
        told.door.catalog, Settings().model_copy(update={"webhook_private_addresses": False})
    )
    monkeypatch.setattr(
        send_module, "parse_webhook_url", lambda url, allow_private: _target_of(told.receiver.url)
    )
    assert told.send(strict) == 1
    assert told.receiver.messages == []
    (delivery,) = told.log()
    assert delivery["state"] == "failed"
    assert "not a public address" in delivery["last_error"]


def _target_of(url: str) -> WebhookTarget:
    return parse_webhook_url(url.replace("127.0.0.1", "localhost"), allow_private=True)


def test_the_connection_goes_to_the_address_that_was_checked(
    told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    told.photo()
    looked_up: list[str] = []
    real = socket.getaddrinfo

    def watched(host: str, *args: Any, **options: Any) -> Any:
        looked_up.append(host)
        return real(host, *args, **options)

    monkeypatch.setattr(socket, "getaddrinfo", watched)
    named = told.receiver.url.replace("127.0.0.1", "localhost")
    with told.door.catalog.write() as session:
        session.execute(update(Webhook).values(url=named))
    told.send()
    assert len(told.receiver.messages) == 1
    assert told.receiver.messages[0].headers["host"].startswith("localhost:")
    assert looked_up.count("localhost") == 1, "once to check it; never again"


@pytest.mark.parametrize("hangs", ["handshake", "head", "body"])
def test_a_receiver_that_hangs_is_not_waited_for(
    told: Told, localhost_tls: ssl.SSLContext, monkeypatch: pytest.MonkeyPatch, hangs: str
) -> None:
    monkeypatch.setattr(send_module, "ATTEMPT_SECONDS", 60.0 if hangs == "body" else 0.5)
    with hanging_receiver(localhost_tls, hangs) as told.receiver.url:
        webhook = told.add("batch.finished")
        told.announce(EventKind.BATCH_FINISHED)
        assert told.send() == 1
    (delivery,) = told.log(webhook)
    if hangs == "body":  # of which nothing is read
        assert (delivery["state"], delivery["last_status"]) == ("delivered", 200)
    else:
        assert (delivery["state"], delivery["last_status"]) == ("pending", None)
        assert delivery["last_error"] == "no answer within 0.5 seconds"


def test_receivers_that_hang_delay_neither_other_webhooks_nor_the_stop(
    told: Told, localhost_tls: ssl.SSLContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    # An attempt has no end of its own here: whoever waited for one would never come back.
    monkeypatch.setattr(send_module, "ATTEMPT_SECONDS", 3600.0)
    looked_up, answered = threading.Event(), threading.Event()
    real = socket.getaddrinfo

    def slow(host: str, *args: Any, **options: Any) -> Any:
        if host == "slow.example" and threading.current_thread().name == "webhook":
            looked_up.set()
            answered.wait()
        return real("localhost" if host == "slow.example" else host, *args, **options)

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    good = told.receiver.url
    stop = threading.Event()
    with (
        hanging_receiver(localhost_tls, "handshake") as no_handshake,
        hanging_receiver(localhost_tls, "head") as no_head,
    ):
        stuck = []
        for told.receiver.url in (no_handshake, no_head, "https://slow.example/"):
            stuck.append(told.add("batch.finished"))
        for _ in range(MAX_IN_FLIGHT + 1):
            told.announce(EventKind.BATCH_FINISHED)
        running = threading.Thread(target=told.sender.run, args=[stop])
        running.start()
        try:
            assert looked_up.wait(60)
            told.receiver.url = good
            late = told.add("generation.switched")
            told.announce(EventKind.GENERATION_SWITCHED)
            for _ in range(600):
                if told.log(late)[0]["state"] == "delivered":
                    break
                time.sleep(0.1)
            assert told.log(late)[0]["state"] == "delivered"
        finally:
            stop.set()
            running.join(60)
            answered.set()
        assert not running.is_alive()
    for webhook in stuck:
        deliveries = told.log(webhook)
        assert {delivery["state"] for delivery in deliveries} == {"pending"}, "due again later"
        tried = sum(delivery["attempts"] for delivery in deliveries)
        assert tried == MAX_IN_FLIGHT, "not all of them at the same time"


@pytest.mark.parametrize("name", ["localhost", "elsewhere.example"])
def test_over_https_only_the_named_host_is_told(told: Told, tmp_path: Path, name: str) -> None:
    server = told.trust(tmp_path, name)
    told.door(ADMIN, "DELETE", f"/webhooks/{told.webhook['id']}")
    with receiving(server) as secured:
        told.receiver = secured
        webhook = told.add("job.succeeded")
        told.photo()
        assert told.send() == 1
        (delivery,) = told.log(webhook)
        if name == "localhost":
            assert delivery["state"] == "delivered"
            assert secured.messages[0].is_signed_with(webhook["secret"])
        else:
            assert secured.messages == []
            assert "certificate verify failed" in delivery["last_error"].lower()


def test_a_switched_generation_is_told_of_and_its_photos_are_not(
    told: Told, vlads: Workplace
) -> None:
    vlads.upload(*range(PHOTOS))
    assert vlads.fit().state == JobState.SUCCEEDED
    told.door(ADMIN, "DELETE", f"/webhooks/{told.webhook['id']}")
    told.add("generation.switched", "job.succeeded")
    before = vlads.active().id
    assert vlads.fit().state == JobState.SUCCEEDED
    while told.send():
        pass
    body = {message.json()["type"]: message.json()["data"] for message in told.receiver.messages}
    assert len(told.receiver.messages) == 2, "one fit, one switch, and no reindex job"
    assert body["job.succeeded"]["kind"] == "fit"
    assert body["generation.switched"]["generation_id"] == str(vlads.active().id)
    assert body["generation.switched"]["replaced_generation_id"] == str(before)


def test_a_deleted_webhook_is_told_nothing_more(told: Told) -> None:
    told.photo()
    deleted = told.door(ADMIN, "DELETE", f"/webhooks/{told.webhook['id']}")
    assert deleted.status_code == 200
    assert told.send() == 0
    assert told.receiver.messages == []
    problem(
        told.door(ADMIN, "GET", f"/webhooks/{told.webhook['id']}/deliveries"),
        404,
        "webhook_not_found",
    )


def test_its_secret_is_shown_once_and_never_logged(
    told: Told, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG):
        secret = told.webhook["secret"]
        listed = told.door(ADMIN, "GET", "/webhooks")
        assert [webhook["id"] for webhook in listed.json()] == [told.webhook["id"]]
        assert secret not in listed.text
        told.photo()
        told.send()
    assert secret not in caplog.text


@pytest.mark.parametrize(
    "url",
    [
        "https://127.0.0.1/",
        "https://localhost/",
        "https://169.254.169.254/latest/meta-data/",
        "https://[::ffff:10.0.0.1]/",
        "http://example.com/",
        "https://no-such-name.invalid/",
    ],
)
def test_a_webhook_to_a_machine_of_our_own_is_refused(
    sqlite_catalog: Catalog, store: FolderStore, url: str
) -> None:
    door = Door(sqlite_catalog, store, Settings())
    params = {"url": url, "events": ["job.failed"]}
    field_refused(door(ADMIN, "POST", "/webhooks", json=params), "url")
    assert door(ADMIN, "GET", "/webhooks").json() == []


def test_a_failed_job_and_a_finished_batch_are_told_of(told: Told, settings: Settings) -> None:
    batches = told.add("batch.finished")
    archive = zip_of({"1.jpg": photo_bytes(1)})
    started = told.door(
        ADMIN, "POST", "/upload/batch", files={"archive": ("photos.zip", archive)}
    ).json()
    store = told.door.store
    worker = BatchWorker(told.door.catalog, store, InProcessWakeups(), settings, "steward")
    worker.run_next(threading.Event())
    told._make_worker().drain(threading.Event())
    with told.door.catalog.write() as session:
        session.execute(update(Job).values(run_after=None))
    worker.run_next(threading.Event())
    (delivery,) = told.log(batches)
    assert delivery["event"] == "batch.finished"
    while told.send():
        pass
    kinds = [(m.json()["type"], m.json()["data"]["kind"]) for m in told.receiver.messages]
    assert sorted(kinds) == [
        ("batch.finished", "batch"),
        ("job.succeeded", "batch"),
        ("job.succeeded", "index"),
    ]
    finished = next(m.json() for m in told.receiver.messages if m.json()["type"][0] == "b")
    assert finished["data"]["job_id"] == started["job_id"]
    assert finished["data"]["result"]["succeeded"] == 1
