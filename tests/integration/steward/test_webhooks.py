"""Webhooks: signed deliveries, retries, and no delivery to internal addresses.

The tests of what is delivered, claimed and retried run on SQLite as well.
"""

from __future__ import annotations

import asyncio
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
from services.steward import webhooks as webhooks_module
from services.steward.batches.worker import BatchWorker
from services.steward.webhooks import (
    MAX_IN_FLIGHT,
    RETRY_DELAYS_SECONDS,
    WebhookDispatcher,
    retry_delay_seconds,
)
from shared.catalog.database.base import db_now
from shared.catalog.database.session import IDLE_SECONDS, Catalog
from shared.catalog.webhooks import Delivery, EventKind, Webhook, enqueue_event
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups, JobState
from shared.security.webhook_targets import WebhookTarget, parse_webhook_url
from shared.storage import FolderStore
from shared.storage.keys import preview_key
from tests.integration.api_with_keys import ADMIN, Door
from tests.integration.harness import Harness
from tests.integration.steward.webhook_receiver import (
    Receiver,
    certificate,
    hanging_receiver,
    receiving,
)
from tests.support.catalog_rows import end_pauses
from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, problem
from tests.support.waiting import wait_until

pytestmark = pytest.mark.databases("postgresql")

BOTH_DATABASES = pytest.mark.databases("sqlite", "postgresql")
PHOTOS = 6


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"webhook_private_addresses": True})


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with receiving() as made:
        yield made


class WebhookSetup:
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
        self.describe()
        return uploaded

    def describe(self) -> None:
        """Describe all queued photos."""
        self._make_worker().drain(threading.Event())

    def log(self, webhook: dict[str, Any] | None = None) -> list[dict[str, Any]]:
        webhook_id = (webhook or self.webhook)["id"]
        answer = self.door(ADMIN, "GET", f"/webhooks/{webhook_id}/deliveries")
        found: list[dict[str, Any]] = answer.json()["deliveries"]
        return found

    def come_due(self) -> None:
        with self.door.catalog.write() as session:
            session.execute(update(Delivery).values(next_attempt_at=db_now()))


@pytest.fixture
def hooks(
    door: Door, settings: Settings, receiver: Receiver, make_worker: Callable[[], ExtractorWorker]
) -> WebhookSetup:
    return WebhookSetup(door, settings, receiver, make_worker)


@pytest.mark.databases("sqlite")
def test_a_retry_is_sent_when_it_is_due_though_nothing_else_happens(
    hooks: WebhookSetup, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhooks_module, "RETRY_DELAYS_SECONDS", (2.0, 3600.0))
    hooks.receiver.status = 500
    hooks.announce(EventKind.JOB_SUCCEEDED)
    stop = threading.Event()
    thread = threading.Thread(target=hooks.sender.run, args=(stop,))
    thread.start()
    try:
        wait_until(lambda: hooks.receiver.messages, 60)
        first = time.monotonic()
        wait_until(lambda: hooks.receiver.messages[1:], 60)
        between = time.monotonic() - first
    finally:
        stop.set()
        thread.join(timeout=60)
    assert between < IDLE_SECONDS - 5, "not at the next look"


@pytest.fixture
def localhost_tls(hooks: WebhookSetup, tmp_path: Path) -> ssl.SSLContext:
    return hooks.trust(tmp_path, "localhost")


def test_a_described_photo_is_delivered_and_signed(hooks: WebhookSetup) -> None:
    uploaded = hooks.photo()
    assert hooks.send() == 1
    (message,) = hooks.receiver.messages
    assert message.path == "/hook?a=1"
    assert message.is_signed_with(hooks.webhook["secret"])
    body = message.json()
    assert body["type"] == "job.succeeded"
    assert body["data"]["job_id"] == uploaded["job_id"]
    assert body["data"]["file_id"] == uploaded["file_id"]
    assert (body["data"]["kind"], body["data"]["map"]) == ("index", "default")
    (delivery,) = hooks.log()
    assert (delivery["state"], delivery["attempts"], delivery["last_status"]) == (
        "delivered",
        1,
        204,
    )
    assert message.headers["webhook-id"] == f"msg_{delivery['event_id']}"
    assert hooks.send() == 0, "a successful delivery is not repeated"
    listed = hooks.door(ADMIN, "GET", "/webhooks")
    assert [webhook["id"] for webhook in listed.json()] == [hooks.webhook["id"]]
    assert hooks.webhook["secret"] not in listed.text, "it is shown once"


def test_a_photo_whose_preview_is_made_again_is_not_delivered_again(hooks: WebhookSetup) -> None:
    uploaded = hooks.door(
        ADMIN, "POST", "/upload", files={"file": ("photo.tiff", photo_bytes(1, "TIFF"))}
    ).json()
    hooks.describe()
    assert hooks.send() == 1
    preview = f"/uploads/{uploaded['file_id']}/preview"
    hooks.door.store.delete(preview_key(UUID(uploaded["file_id"])))
    assert hooks.door(ADMIN, "GET", preview).status_code == 202
    hooks.describe()
    assert hooks.door(ADMIN, "GET", preview).status_code == 200
    assert hooks.send() == 0


def test_a_failed_job_is_delivered_with_its_error(hooks: WebhookSetup) -> None:
    torn = photo_bytes(1, "PNG")[:-100]
    uploaded = hooks.door(ADMIN, "POST", "/upload", files={"file": ("torn.png", torn)}).json()
    hooks.describe()
    assert hooks.send() == 1
    (message,) = hooks.receiver.messages
    body = message.json()
    assert (body["type"], body["data"]["job_id"]) == ("job.failed", uploaded["job_id"])
    assert body["data"]["error"]["code"] == "undecodable_photo"


@BOTH_DATABASES
def test_only_subscribed_events_are_delivered_and_to_each_webhook_alone(
    hooks: WebhookSetup,
) -> None:
    other, switches = hooks.add("job.succeeded"), hooks.add("generation.switched")
    hooks.photo()
    assert hooks.send() == 2
    ids = {message.headers["webhook-id"] for message in hooks.receiver.messages}
    assert len(ids) == 1, "one event"
    signed = [
        [message.is_signed_with(hook["secret"]) for hook in (hooks.webhook, other)]
        for message in hooks.receiver.messages
    ]
    assert sorted(signed) == [[False, True], [True, False]]
    assert hooks.log(switches) == []


@BOTH_DATABASES
def test_failed_deliveries_are_retried_later_under_the_same_id(hooks: WebhookSetup) -> None:
    hooks.photo()
    hooks.receiver.status = 500
    assert hooks.send() == 1
    (waits,) = hooks.log()
    assert (waits["state"], waits["last_status"]) == ("pending", 500)
    assert waits["next_attempt_at"] is not None
    assert hooks.send() == 0, "not at once"
    hooks.come_due()
    hooks.receiver.status = 200
    assert hooks.send() == 1
    assert [entry["state"] for entry in hooks.log()] == ["delivered"]
    first, second = hooks.receiver.messages
    assert first.headers["webhook-id"] == second.headers["webhook-id"]
    assert first.body == second.body


def test_retries_back_off_for_three_days_and_then_end(hooks: WebhookSetup) -> None:
    hooks.photo()
    hooks.receiver.status = 503
    for _ in range(len(RETRY_DELAYS_SECONDS)):
        assert hooks.send() == 1
        assert hooks.log()[0]["state"] == "pending"
        hooks.come_due()
    assert hooks.send() == 1
    assert hooks.log()[0]["state"] == "failed"
    hooks.come_due()
    assert hooks.send() == 0
    pauses = [retry_delay_seconds(attempts) for attempts in range(1, len(RETRY_DELAYS_SECONDS) + 1)]
    assert pauses == sorted(pauses, key=lambda pause: pause or 0)
    assert 2 * 86_400 < sum(pause or 0 for pause in pauses) < 5 * 86_400


@BOTH_DATABASES
def test_an_attempt_whose_steward_crashed_is_repeated(hooks: WebhookSetup) -> None:
    hooks.photo()
    _, claimed = hooks.sender._claim_due(UUID(hooks.webhook["id"]))  # and then it dies
    assert len(claimed) == 1
    assert hooks.send() == 0, "another steward leaves it alone for a while"
    hooks.come_due()
    assert hooks.send() == 1
    assert hooks.log()[0]["attempts"] == 2


def test_a_redirect_is_not_followed(hooks: WebhookSetup) -> None:
    with receiving() as inside:
        hooks.receiver.status = 302
        hooks.receiver.headers = {"Location": inside.url}
        hooks.photo()
        hooks.send()
        assert inside.messages == []
    (delivery,) = hooks.log()
    assert delivery["last_status"] == 302
    assert "redirects are not followed" in delivery["last_error"]


def test_a_host_that_has_become_private_is_not_called(
    hooks: WebhookSetup, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As DNS rebinding does it: public when the webhook was made, loopback when it is called.
    hooks.photo()
    strict = WebhookDispatcher(
        hooks.door.catalog, Settings().model_copy(update={"webhook_private_addresses": False})
    )
    monkeypatch.setattr(
        webhooks_module,
        "parse_webhook_url",
        lambda url, allow_private: _target_of(hooks.receiver.url),
    )
    assert hooks.send(strict) == 1
    assert hooks.receiver.messages == []
    (delivery,) = hooks.log()
    assert delivery["state"] == "failed"
    assert "not a public address" in delivery["last_error"]


def _target_of(url: str) -> WebhookTarget:
    return parse_webhook_url(url.replace("127.0.0.1", "localhost"), allow_private=True)


def test_the_connection_goes_to_the_address_that_was_checked(
    hooks: WebhookSetup, monkeypatch: pytest.MonkeyPatch
) -> None:
    hooks.photo()
    looked_up: list[str] = []
    real = socket.getaddrinfo

    def watched(host: str, *args: Any, **options: Any) -> Any:
        looked_up.append(host)
        return real(host, *args, **options)

    monkeypatch.setattr(socket, "getaddrinfo", watched)
    named = hooks.receiver.url.replace("127.0.0.1", "localhost")
    with hooks.door.catalog.write() as session:
        session.execute(update(Webhook).values(url=named))
    hooks.send()
    assert len(hooks.receiver.messages) == 1
    assert hooks.receiver.messages[0].headers["host"].startswith("localhost:")
    assert looked_up.count("localhost") == 1, "once to check it; never again"


@pytest.mark.parametrize("hangs", ["handshake", "head", "body"])
def test_a_delivery_to_a_hanging_receiver_times_out(
    hooks: WebhookSetup, localhost_tls: ssl.SSLContext, monkeypatch: pytest.MonkeyPatch, hangs: str
) -> None:
    monkeypatch.setattr(webhooks_module, "ATTEMPT_SECONDS", 60.0 if hangs == "body" else 0.5)
    with hanging_receiver(localhost_tls, hangs) as hooks.receiver.url:
        webhook = hooks.add("batch.finished")
        hooks.announce(EventKind.BATCH_FINISHED)
        assert hooks.send() == 1
    (delivery,) = hooks.log(webhook)
    if hangs == "body":  # of which nothing is read
        assert (delivery["state"], delivery["last_status"]) == ("delivered", 200)
    else:
        assert (delivery["state"], delivery["last_status"]) == ("pending", None)
        assert delivery["last_error"] == "no answer within 0.5 seconds"


def test_receivers_that_hang_delay_neither_other_webhooks_nor_the_stop(
    hooks: WebhookSetup, localhost_tls: ssl.SSLContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    # An attempt has no end of its own here: whoever waited for one would never come back.
    monkeypatch.setattr(webhooks_module, "ATTEMPT_SECONDS", 3600.0)
    looked_up, answered = threading.Event(), threading.Event()
    real = socket.getaddrinfo

    def slow(host: str, *args: Any, **options: Any) -> Any:
        if host == "slow.example" and threading.current_thread().name == "webhook":
            looked_up.set()
            answered.wait()
        return real("localhost" if host == "slow.example" else host, *args, **options)

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    good = hooks.receiver.url
    stop = threading.Event()
    with (
        hanging_receiver(localhost_tls, "handshake") as no_handshake,
        hanging_receiver(localhost_tls, "head") as no_head,
    ):
        stuck = []
        for hooks.receiver.url in (no_handshake, no_head, "https://slow.example/"):
            stuck.append(hooks.add("batch.finished"))
        for _ in range(MAX_IN_FLIGHT + 1):
            hooks.announce(EventKind.BATCH_FINISHED)
        running = threading.Thread(target=hooks.sender.run, args=[stop])
        running.start()
        try:
            assert looked_up.wait(60)
            hooks.receiver.url = good
            late = hooks.add("generation.switched")
            hooks.announce(EventKind.GENERATION_SWITCHED)
            wait_until(lambda: hooks.log(late)[0]["state"] == "delivered", 60)
        finally:
            stop.set()
            running.join(60)
            answered.set()
        assert not running.is_alive()
    for webhook in stuck:
        deliveries = hooks.log(webhook)
        assert {delivery["state"] for delivery in deliveries} == {"pending"}, "due again later"
        tried = sum(delivery["attempts"] for delivery in deliveries)
        assert tried == MAX_IN_FLIGHT, "not all of them at the same time"


@pytest.mark.parametrize("name", ["localhost", "elsewhere.example"])
def test_over_https_only_the_named_host_gets_deliveries(
    hooks: WebhookSetup, tmp_path: Path, name: str
) -> None:
    server = hooks.trust(tmp_path, name)
    hooks.door(ADMIN, "DELETE", f"/webhooks/{hooks.webhook['id']}")
    with receiving(server) as secured:
        hooks.receiver = secured
        webhook = hooks.add("job.succeeded")
        hooks.photo()
        assert hooks.send() == 1
        (delivery,) = hooks.log(webhook)
        if name == "localhost":
            assert delivery["state"] == "delivered"
            assert secured.messages[0].is_signed_with(webhook["secret"])
        else:
            assert secured.messages == []
            assert "certificate verify failed" in delivery["last_error"].lower()


def test_a_switched_generation_is_delivered_and_its_photos_are_not(
    hooks: WebhookSetup, vlads: Harness
) -> None:
    vlads.upload(*range(PHOTOS))
    assert vlads.fit().state == JobState.SUCCEEDED
    hooks.door(ADMIN, "DELETE", f"/webhooks/{hooks.webhook['id']}")
    hooks.add("generation.switched", "job.succeeded")
    before = vlads.active().id
    assert vlads.fit().state == JobState.SUCCEEDED
    while hooks.send():
        pass
    body = {message.json()["type"]: message.json()["data"] for message in hooks.receiver.messages}
    assert len(hooks.receiver.messages) == 2, "one fit, one switch, and no reindex job"
    assert body["job.succeeded"]["kind"] == "fit"
    assert body["generation.switched"]["generation_id"] == str(vlads.active().id)
    assert body["generation.switched"]["replaced_generation_id"] == str(before)


def test_a_deleted_webhook_gets_nothing_more(hooks: WebhookSetup) -> None:
    hooks.photo()
    deleted = hooks.door(ADMIN, "DELETE", f"/webhooks/{hooks.webhook['id']}")
    assert deleted.status_code == 200
    assert hooks.send() == 0
    assert hooks.receiver.messages == []
    problem(
        hooks.door(ADMIN, "GET", f"/webhooks/{hooks.webhook['id']}/deliveries"),
        404,
        "webhook_not_found",
    )


@pytest.mark.databases("sqlite")
@pytest.mark.parametrize("url", ["https://localhost/", "https://no-such-name.invalid/"])
def test_a_webhook_to_a_private_or_unresolvable_host_is_refused(
    catalog: Catalog, store: FolderStore, url: str
) -> None:
    door = Door(catalog, store, Settings())
    params = {"url": url, "events": ["job.failed"]}
    field_refused(door(ADMIN, "POST", "/webhooks", json=params), "url")
    assert door(ADMIN, "GET", "/webhooks").json() == []


def test_a_finished_batch_is_delivered_with_the_jobs_of_it_and_its_photo(
    hooks: WebhookSetup, settings: Settings
) -> None:
    batches = hooks.add("batch.finished")
    started = hooks.door(
        ADMIN, "POST", "/upload/batch", files={"file": ("1.jpg", photo_bytes(1))}
    ).json()
    store = hooks.door.store
    worker = BatchWorker(hooks.door.catalog, store, InProcessWakeups(), settings, "steward")
    worker.run_next(threading.Event())
    hooks.describe()
    end_pauses(hooks.door.catalog)
    worker.run_next(threading.Event())
    (delivery,) = hooks.log(batches)
    assert delivery["event"] == "batch.finished"
    while hooks.send():
        pass
    kinds = [(m.json()["type"], m.json()["data"]["kind"]) for m in hooks.receiver.messages]
    assert sorted(kinds) == [
        ("batch.finished", "batch"),
        ("job.succeeded", "batch"),
        ("job.succeeded", "index"),
    ]
    finished = next(m.json() for m in hooks.receiver.messages if m.json()["type"][0] == "b")
    assert finished["data"]["job_id"] == started["job_id"]
    assert finished["data"]["result"]["succeeded"] == 1
