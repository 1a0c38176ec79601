"""Webhooks to real receivers on this machine, which the settings allow."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import queue
import ssl
import threading
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import httpx
import pytest
import trustme
from standardwebhooks import Webhook, WebhookVerificationError

from service.targets import Targets
from service.webhooks import AT_ONCE, OF_A_HOST, Answer, Sender
from tests.conftest import redis_running
from tests.service.conftest import (
    api_running,
    finished,
    free_port,
    problem,
    settings_for,
    submit,
    wait_for,
)
from worker.outbox import Message, Outbox
from worker.pool import WorkerPool
from worker.records import JobRecord, RecordStore
from worker.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from tests.conftest import RedisProcess
    from tests.service.conftest import Api

SECRET = "whsec_" + base64.b64encode(b"k" * 32).decode()
FORMER = "whsec_" + base64.b64encode(b"f" * 24).decode()
BAD_PROBLEM = {"type": "/problems/odd-row-count", "title": "t", "status": 422, "detail": "d"}


@dataclass
class Delivery:
    path: str
    headers: dict[str, str]
    body: bytes

    def verified(self, secret: str = SECRET) -> dict[str, Any]:
        document: dict[str, Any] = Webhook(secret).verify(self.body, self.headers)
        return document


@dataclass
class Receiver:
    """An HTTP server that answers what it is told to, then 204."""

    url: str
    answers: queue.SimpleQueue[tuple[int, dict[str, str]]] = field(
        default_factory=queue.SimpleQueue
    )
    got: queue.SimpleQueue[Delivery] = field(default_factory=queue.SimpleQueue)
    held: threading.Event = field(default_factory=threading.Event)

    def next(self, seconds: float = 15) -> Delivery:
        return self.got.get(timeout=seconds)


@contextlib.contextmanager
def receiving(tls: ssl.SSLContext | None = None) -> Iterator[Receiver]:
    told = Receiver("")

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            headers = {name.lower(): value for name, value in self.headers.items()}
            told.got.put(Delivery(self.path, headers, body))
            told.held.wait(20)
            status, more = 204, dict[str, str]()
            with contextlib.suppress(queue.Empty):
                status, more = told.answers.get_nowait()
            self.send_response(status)
            for name, value in more.items():
                self.send_header(name, value)
            self.send_header("Connection", "close")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    if tls is not None:
        server.socket = tls.wrap_socket(server.socket, server_side=True)
    told.url = f"http://127.0.0.1:{server.server_address[1]}/hook?k=1"
    told.held.set()
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield told
    finally:
        told.held.set()
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with receiving() as found:
        yield found


def hooked(folder: Path, redis: RedisProcess, **more: Any) -> Settings:
    given = {
        "webhook_secret": SECRET,
        "webhook_http": True,
        "webhook_allow": "127.0.0.0/8",
        "webhook_pauses": (0.2, 0.2, 0.2),
    }
    return settings_for(folder, redis, **(given | more))


@pytest.fixture(scope="module")
def hooked_api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """An API that delivers webhooks, with a worker."""
    folder = tmp_path_factory.mktemp("hooked")
    with redis_running(folder) as redis:
        settings = hooked(folder, redis, public_url="https://smsr.example/api")
        with WorkerPool(settings, 1), api_running(settings, redis, folder / "api.log") as api:
            yield api


def ended(store: RecordStore, url: str, status: str = "succeeded") -> str:
    """Make a job with a webhook end."""
    record = JobRecord.new(options={}, inputs={}, webhook=url)
    store.create(record)
    if status == "cancelled":
        store.cancel(record.id)
        return record.id
    attempt = store.begin_attempt(record.id, worker="ann", ticket="t", lease=60)
    assert attempt is not None
    if status == "failed":
        store.fail(record.id, attempt, BAD_PROBLEM)
    else:
        store.publish(record.id, attempt, frames=3, points=4, timings={})
    return record.id


def state(api: Api, job_id: str) -> dict[str, Any]:
    found: dict[str, Any] = httpx.get(f"{api.url}/v1/jobs/{job_id}").json()["webhook"]
    return found


def test_a_job_that_was_submitted_with_a_webhook(
    hooked_api: Api, receiver: Receiver, tracks: bytes
) -> None:
    with hooked_api.client() as client:
        files = {"measurements": ("w.npy", tracks)}
        answer = client.post("/v1/jobs", files=files, data={"webhook": receiver.url})
        assert answer.json()["webhook"]["host"] == "127.0.0.1"
        job = finished(client, answer)
        delivery = receiver.next()
        message = delivery.verified()
        assert delivery.path == "/hook?k=1"
        assert delivery.headers["content-type"] == "application/json"
        assert delivery.headers["host"] == receiver.url.split("/")[2]
        assert message["type"] == "job.succeeded"
        assert message["timestamp"] == job["finished_at"]
        assert message["data"]["id"] == job["id"]
        here = f"https://smsr.example/api/v1/jobs/{job['id']}"
        assert message["data"]["links"]["self"] == here
        wait_for(lambda: state(hooked_api, job["id"])["state"] == "delivered")
        shown = client.get(f"/v1/jobs/{job['id']}")
        assert shown.json()["webhook"]["attempts"] == 1
        assert shown.json()["webhook"]["status"] == 204
        assert shown.json()["webhook"]["delivered_at"] is not None
        for secret in (SECRET, "/hook"):
            assert secret not in shown.text
    with pytest.raises(WebhookVerificationError):
        delivery.verified(FORMER)
    with pytest.raises(WebhookVerificationError):
        Webhook(SECRET).verify(delivery.body + b" ", delivery.headers)


@pytest.mark.parametrize("status", ["succeeded", "failed", "cancelled"])
def test_every_end_is_told(hooked_api: Api, receiver: Receiver, status: str) -> None:
    job_id = ended(RecordStore(hooked_api.redis.client()), receiver.url, status)
    message = receiver.next().verified()
    assert message["type"] == f"job.{status}"
    assert (message["data"]["id"], message["data"]["status"]) == (job_id, status)
    if status == "failed":
        assert message["data"]["problem"]["type"] == "/problems/odd-row-count"


def test_a_failing_receiver_is_tried_again(hooked_api: Api, receiver: Receiver) -> None:
    for answer in ((500, {}), (429, {"Retry-After": "1"}), (302, {"Location": "/elsewhere"})):
        receiver.answers.put(answer)
    job_id = ended(RecordStore(hooked_api.redis.client()), receiver.url)
    deliveries = []
    times = []
    for _ in range(4):
        deliveries.append(receiver.next())
        times.append(time.monotonic())
    assert len({delivery.headers["webhook-id"] for delivery in deliveries}) == 1
    assert len({delivery.body for delivery in deliveries}) == 1
    assert {delivery.path for delivery in deliveries} == {"/hook?k=1"}
    for delivery in deliveries:
        delivery.verified()
    assert times[2] - times[1] >= 0.9
    wait_for(lambda: state(hooked_api, job_id)["state"] == "delivered")
    assert state(hooked_api, job_id)["attempts"] == 4
    assert hooked_api.redis.client().exists("smsr:webhooks") == 0
    assert list(hooked_api.redis.client().scan_iter("smsr:webhook:*")) == []
    metrics = httpx.get(f"{hooked_api.url}/metrics").text
    assert 'smsr_webhook_attempts_total{outcome="failed"}' in metrics


def test_after_the_last_pause_it_is_given_up(hooked_api: Api, receiver: Receiver) -> None:
    for _ in range(4):
        receiver.answers.put((503, {}))
    job_id = ended(RecordStore(hooked_api.redis.client()), receiver.url)
    wait_for(lambda: state(hooked_api, job_id)["state"] == "given_up", 20)
    shown = state(hooked_api, job_id)
    assert (shown["attempts"], shown["status"]) == (4, 503)
    assert shown["error"] == "The receiver answered 503."


def test_gone_is_gone(hooked_api: Api, receiver: Receiver) -> None:
    receiver.answers.put((410, {}))
    job_id = ended(RecordStore(hooked_api.redis.client()), receiver.url)
    wait_for(lambda: state(hooked_api, job_id)["state"] == "given_up")
    assert state(hooked_api, job_id)["attempts"] == 1


def test_a_receiver_that_is_not_there(hooked_api: Api) -> None:
    url = f"http://127.0.0.1:{free_port()}/secret"
    job_id = ended(RecordStore(hooked_api.redis.client()), url)
    wait_for(lambda: state(hooked_api, job_id)["attempts"] >= 1)
    shown = state(hooked_api, job_id)
    assert shown["error"] == "No connection to the receiver could be made."
    assert "secret" not in json.dumps(shown)


def test_a_job_that_is_deleted_is_told_of_all_the_same(hooked_api: Api, receiver: Receiver) -> None:
    receiver.answers.put((500, {}))
    store = RecordStore(hooked_api.redis.client())
    job_id = ended(store, receiver.url)
    receiver.next()
    store.delete(job_id)
    assert receiver.next().verified()["data"]["id"] == job_id
    assert store.get(job_id) is None


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("http://10.0.0.1/", "public Internet"),
        ("https://[::ffff:127.0.0.1]/", "public Internet"),
        ("https://169.254.169.254/latest/meta-data", "public Internet"),
        ("https://0x7f.1/", "number"),
        ("https://user:secret@example.org/", "user name"),
        ("ftp://example.org/", "https://"),
        ("https://127.0.0.1:22/", "port"),
        ("https://nobody.invalid/", "resolved"),
    ],
)
def test_refused_at_submission(hooked_api: Api, tracks: bytes, url: str, why: str) -> None:
    with hooked_api.client() as client:
        before = hooked_api.stored()
        files = {"measurements": ("w.npy", tracks)}
        answer = client.post("/v1/jobs", files=files, data={"webhook": url})
        document = problem(answer, "invalid-setting", 422)
        assert document["setting"] == "webhook"
        assert why in document["detail"]
        assert "secret" not in answer.text
        wait_for(lambda: hooked_api.stored() <= before)


def test_without_a_key_there_are_no_webhooks(client: httpx.Client, tracks: bytes) -> None:
    files = {"measurements": ("w.npy", tracks)}
    answer = client.post("/v1/jobs", files=files, data={"webhook": "https://example.org/"})
    assert "no webhooks" in problem(answer, "invalid-setting", 422)["detail"]
    assert finished(client, submit(client, files))["webhook"] is None


def test_another_process_delivers_when_one_dies(tmp_path: Path, receiver: Receiver) -> None:
    with redis_running(tmp_path) as redis:
        settings = hooked(tmp_path, redis, webhook_timeout_seconds=1)
        store = RecordStore(redis.client())
        receiver.held.clear()
        with api_running(settings, redis, tmp_path / "first.log") as first:
            job_id = ended(store, receiver.url)
            early = receiver.next()
            first.process.kill()
        receiver.held.set()
        with api_running(settings, redis, tmp_path / "second.log") as second:
            late = receiver.next(20)
            assert late.headers["webhook-id"] == early.headers["webhook-id"]
            assert late.body == early.body
            wait_for(lambda: state(second, job_id)["state"] == "delivered")
            assert state(second, job_id)["attempts"] == 2


def test_two_processes_do_not_deliver_twice(redis_process: RedisProcess, redis_url: str) -> None:
    store = RecordStore(redis_process.client())
    jobs = {ended(store, "http://127.0.0.1:1/") for _ in range(20)}
    one, other = Outbox(redis_process.client()), Outbox(redis_process.client())
    claimed = one.claim(60, 8) + other.claim(60, 8) + one.claim(60, 8) + other.claim(60, 8)
    assert len(claimed) == 20
    assert {message.record.id for message in claimed} == jobs
    assert {message.attempt for message in claimed} == {1}


def test_a_claim_that_ran_out_settles_nothing(redis_process: RedisProcess, redis_url: str) -> None:
    store, outbox = RecordStore(redis_process.client()), Outbox(redis_process.client())
    ended(store, "http://127.0.0.1:1/")
    (first,) = outbox.claim(0.01, 8)
    time.sleep(0.05)
    (second,) = outbox.claim(60, 8)
    assert (second.id, second.attempt) == (first.id, 2)
    assert not outbox.settle(first, "delivered")
    assert outbox.settle(second, "delivered")
    assert not outbox.settle(second, "delivered")
    assert outbox.claim(60, 8) == []


def test_a_job_that_ends_twice_is_two_messages(redis_process: RedisProcess, redis_url: str) -> None:
    store, outbox = RecordStore(redis_process.client()), Outbox(redis_process.client())
    job_id = ended(store, "http://127.0.0.1:1/", "failed")
    store.retry(job_id)
    store.cancel(job_id)
    messages = outbox.claim(60, 8)
    assert [message.record.status for message in messages] == ["failed", "cancelled"]
    assert len({message.id for message in messages}) == 2
    outbox.settle(messages[0], "given_up")
    record = store.get(job_id)
    assert record is not None
    assert record.webhook_state is None, "of the last end only"


def message_to(url: str) -> Message:
    record = JobRecord.new(options={}, inputs={}, webhook=url)
    return Message("msg_1", 1, url, record)


def sent(url: str, settings: Settings, answers: Sequence[Sequence[str]] | None = None) -> Answer:
    """Send one message; the name resolves to each of the answers in turn."""
    remaining = list(answers or ())

    async def resolve(host: str, port: int) -> Sequence[str]:
        return remaining.pop(0)

    async def send() -> Answer:
        targets = Targets(settings, resolve) if answers else Targets(settings)
        async with Sender(settings, targets) as sender:
            return await sender.send(message_to(url))

    return asyncio.run(send())


def allowing(networks: str, **more: Any) -> Settings:
    return Settings(
        redis_url="redis://localhost",
        webhook_secret=f"{SECRET} {FORMER}",
        webhook_http=True,
        webhook_allow=networks,
        webhook_timeout_seconds=2,
        **more,
    )


def test_the_address_that_was_checked_is_the_one_connected_to(receiver: Receiver) -> None:
    """A name that resolves to something else a moment later is not asked again."""
    port = receiver.url.split("/")[2].partition(":")[2]
    url = f"http://rebinding.example:{port}/hook"
    settings = allowing("127.0.0.1/32")
    assert sent(url, settings, [["127.0.0.1"], ["127.0.0.2"]]).delivered
    delivery = receiver.next()
    assert delivery.headers["host"] == f"rebinding.example:{port}"
    delivery.verified(SECRET)
    delivery.verified(FORMER)
    refused = sent(url, settings, [["127.0.0.2"]])
    assert "public Internet" in str(refused.error)
    assert receiver.got.empty()


def test_another_address_of_the_name_is_tried(receiver: Receiver) -> None:
    port = receiver.url.split("/")[2].partition(":")[2]
    found = ["127.0.0.9", "127.0.0.1"]
    assert sent(f"http://two.example:{port}/", allowing("127.0.0.0/8"), [found]).delivered


@dataclass
class Secured:
    """A receiver with a certificate, and the names that clients asked it for."""

    receiver: Receiver
    names: list[str | None]

    @property
    def port(self) -> str:
        return self.receiver.url.split("/")[2].partition(":")[2]


@contextlib.contextmanager
def secured(authority: trustme.CA, *names: str, **more: Any) -> Iterator[Secured]:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert(*names, **more).configure_cert(context)
    asked: list[str | None] = []
    context.sni_callback = lambda _socket, name, _context: asked.append(name)
    with receiving(context) as receiver:
        yield Secured(receiver, asked)


@pytest.fixture
def authority(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> trustme.CA:
    """An authority of the operator's own, as SSL_CERT_FILE names it."""
    made = trustme.CA()
    made.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "ca.pem"))
    return made


def test_the_certificate_is_checked_for_the_name_not_the_address(authority: trustme.CA) -> None:
    settings = allowing("127.0.0.1/32")
    with secured(authority, "hooks.example") as one:
        url = f"https://hooks.example:{one.port}/hook"
        answer = sent(url, settings, [["127.0.0.1"]])
        assert answer.delivered, answer
        delivery = one.receiver.next()
        assert delivery.headers["host"] == f"hooks.example:{one.port}"
        assert one.names == ["hooks.example"]
        # An address instead of a name is checked as one, and is no server name (RFC 6066).
        assert sent(f"https://127.0.0.1:{one.port}/", settings).error == UNVERIFIED
        assert one.names == ["hooks.example", None]
        assert one.receiver.got.empty()
    with secured(authority, "127.0.0.1") as one:
        assert sent(f"https://127.0.0.1:{one.port}/", settings).delivered


UNVERIFIED = "The certificate of the receiver could not be verified."


@pytest.mark.parametrize("how", ["other name", "address", "unknown authority", "expired"])
def test_a_receiver_without_a_good_certificate_learns_nothing(
    authority: trustme.CA, how: str
) -> None:
    names = {"other name": "other.example", "address": "127.0.0.1"}
    issuer = trustme.CA() if how == "unknown authority" else authority
    more = {"not_after": datetime(2020, 1, 1, tzinfo=UTC)} if how == "expired" else {}
    with secured(issuer, names.get(how, "hooks.example"), **more) as one:
        url = f"https://hooks.example:{one.port}/hook"
        answer = sent(url, allowing("127.0.0.1/32"), [["127.0.0.1"]])
        assert (answer.delivered, answer.error) == (False, UNVERIFIED)
        assert one.receiver.got.empty()


def test_a_host_that_does_not_answer_holds_up_no_other(hooked_api: Api, receiver: Receiver) -> None:
    store = RecordStore(hooked_api.redis.client())
    with receiving() as silent:
        silent.held.clear()
        for _ in range(AT_ONCE + 8):
            ended(store, silent.url)
        wait_for(lambda: silent.got.qsize() >= OF_A_HOST)
        job_id = ended(store, receiver.url)
        assert receiver.next(5).verified()["data"]["id"] == job_id
        assert silent.got.qsize() == OF_A_HOST
        silent.held.set()
        wait_for(lambda: silent.got.qsize() == AT_ONCE + 8, 30)
        wait_for(lambda: not hooked_api.redis.client().exists("smsr:webhooks"))


def test_many_messages_to_a_busy_host_are_put_off(
    redis_process: RedisProcess, redis_url: str
) -> None:
    client = redis_process.client()
    store, outbox = RecordStore(client), Outbox(client)
    for _ in range(1000):
        ended(store, "https://busy.example/hook")
    ended(store, "https://Other.example:8443/hook")
    busy = {"busy.example": 3}
    assert outbox.claim(20, 10, each=3, busy=busy) == []
    (found,) = outbox.claim(20, 10, each=3, busy=busy)
    assert found.host == "other.example:8443"
    due = client.zcount("smsr:webhooks", "-inf", time.time())
    assert due == 0, "those of the busy host are due in some seconds"
    assert client.zcard("smsr:webhooks") == 1001


def test_redirects_and_proxies_are_not_followed(
    receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    with receiving() as inside:
        for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
            monkeypatch.setenv(name, inside.url)
        receiver.answers.put((307, {"Location": inside.url}))
        answer = sent(receiver.url, allowing("127.0.0.0/8"))
        assert (answer.status, answer.delivered) == (307, False)
        assert inside.got.empty()


def test_a_receiver_that_never_answers(receiver: Receiver) -> None:
    receiver.held.clear()
    began = time.monotonic()
    answer = sent(receiver.url, allowing("127.0.0.0/8"))
    assert answer.error == "The receiver did not answer in time."
    assert time.monotonic() - began < 5
