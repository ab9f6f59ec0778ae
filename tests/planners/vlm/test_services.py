"""Services against a server on loopback: what is sent, what is understood, and every way in which it can fail."""

from __future__ import annotations

import base64
import json
import re
from types import SimpleNamespace

import pytest
import torch

from sagemp_cli.config.binding import build
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.planners.vlm import VLM, AnswerError, ServiceError
from sagemp_cli.planners.vlm import service as service_module
from sagemp_cli.planners.vlm.service import ENDPOINTS, _retry_after

KEY = "a-secret-key"
START = torch.tensor([-1.5, -0.2, 0.0], dtype=torch.float64)
GOOD = '{"waypoints": [[-0.3, -0.3], [0.3, -0.4]]}'


pytestmark = pytest.mark.usefixtures("in_this_process")
both = pytest.mark.parametrize("provider", ["gemini", "openai"])


@both
def test_the_prompt_and_the_picture_are_sent_as_the_protocol_says(ask, server, provider):
    ask(GOOD, temperature=0.5, model="some-model")
    (request,) = server.requests
    body = request["body"]
    assert request["path"] == "/chat/completions" and request["headers"]["authorization"] == f"Bearer {KEY}"
    assert body["model"] == "some-model" and body["temperature"] == 0.5
    assert ("seed" in body) == (provider == "openai")  # Gemini refuses requests with one
    text, image = body["messages"][0]["content"]
    text, (head, png) = text["text"], image["image_url"]["url"].split(",")
    assert head == "data:image/png;base64"
    assert "except the burger" in text and "**Start Point (Green Dot):** [-0.75, -0.10]" in text
    assert "**Goal Point (Red Dot):** [0.75, 0.07]" in text
    assert base64.b64decode(png).startswith(b"\x89PNG")
    assert KEY not in json.dumps(body) and KEY not in request["path"]


@both
def test_the_waypoints_become_a_reference_from_the_start_to_the_goals_middle(ask, table):
    (reference,) = ask(GOOD)
    assert reference.shape == (21, 3) and reference.dtype == torch.float64
    assert reference[0].tolist() == [-1.5, -0.2, 0.0]
    torch.testing.assert_close(reference[-1, :2], torch.tensor([1.5, 0.15], dtype=torch.float64))
    for place in ([-0.6, -0.6], [0.6, -0.8]):
        assert float((reference[:, :2] - torch.tensor(place)).norm(dim=-1).min()) < 0.15


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("", "the answer is empty"),
        ("I am unable to do that.", "the model refuses: 'I am unable to do that.'"),
        ('{"waypoints": []}', "lists no waypoints"),
        (json.dumps({"waypoints": [[0, 0]] * 101}), "lists 101 waypoints, at most 100"),
        ('{"waypoints": [[0, 7]]}', "waypoints[0] lies outside the image"),
        ('{"waypoints": [["a", 7]]}', "waypoints[0][0] must be a finite number"),
        ("turn left", "holds no JSON object"),
    ],
)
def test_an_unusable_answer_is_an_error_in_one_line(ask, answer, message):
    with pytest.raises(AnswerError, match=re.escape(message)) as caught:
        ask(answer)
    assert str(caught.value).startswith("no usable answer in 1 attempts: ")


@pytest.mark.parametrize("wrapped", [f"Of course:\n{GOOD}\nEnjoy!", f"```json\n{GOOD}\n```"])
def test_prose_and_fences_around_the_answer_change_nothing(ask, wrapped):
    assert torch.equal(ask(wrapped), ask(GOOD))


def test_after_an_unusable_answer_the_model_is_asked_again(ask, server):
    ask("no", GOOD, attempts=2)
    assert len(server.requests) == 2
    assert server.requests[0]["body"]["seed"] != server.requests[1]["body"]["seed"]


@pytest.mark.parametrize(
    "choice",
    [{"message": {"content": None, "refusal": "SAFETY"}}, {"message": {}, "finish_reason": "content_filter"}],
)
def test_a_service_that_blocks_the_answer_is_a_refusal(reply, ask, choice):
    with pytest.raises(AnswerError, match=re.escape("the model refuses: 'refused by the")):
        ask(reply(body={"choices": [choice]}))


@pytest.mark.parametrize("status", [429, 500, 503])
def test_a_temporary_failure_is_tried_again(reply, ask, server, status):
    ask(reply(status, "later"), GOOD)
    assert len(server.requests) == 2


def test_retry_after_is_waited_for(reply, ask, clock):
    ask(reply(429, "slow down", {"Retry-After": "0.4"}), GOOD)
    assert clock() > 0.4


def test_a_wait_beyond_the_time_limit_is_not_begun(reply, ask, server, clock):
    message = "gave up after 1 requests, the next would come after the time limit of 2 s a plan (429: slow down)"
    with pytest.raises(ServiceError, match=re.escape(message)):
        ask(reply(429, "slow down", {"Retry-After": "3600"}), GOOD, time_limit=2.0)
    assert len(server.requests) == 1 and clock() < 60  # not an hour


@pytest.mark.parametrize(
    ("value", "seconds"),
    [
        (None, 0),
        ("2.5", 2.5),
        ("-3", 0),
        ("nan", 0),
        ("1e999", float("inf")),
        ("9" * 5000, float("inf")),
        ("soon", 0),
        ("Fri, 31 Dec 999999999999 23:59:59 GMT", 0),
        ("Fri, 31 Dec 9999 23:59:59 -9999", 0),
        ("Mon, 01 Jan 2001 00:00:00 GMT", 0),
        ("Mon, 01 Jan 2001 00:00:00", 0),
    ],
)
def test_retry_after_is_seconds_whatever_stands_there(value, seconds):
    found = _retry_after(value)
    assert found == seconds or (str(value).startswith("Fri") and found > 1e9)


@pytest.mark.parametrize("value", ["1e999", "9" * 5000, "Fri, 31 Dec 9999 23:59:59 GMT"])
def test_no_wait_is_longer_than_the_time_limit(reply, ask, value):
    with pytest.raises(ServiceError, match="the next would come after the time limit of 300 s"):
        ask(reply(503, "later", {"Retry-After": value}))


@pytest.mark.parametrize("count", [1, 2])
def test_the_time_limit_is_one_for_all_that_is_asked_for_a_plan(ask, monkeypatch, count):
    now, asked = [100.0], []

    def slow(request, seconds):  # an answer that is of no use, after 3 s
        asked.append(seconds)
        now[0] += min(seconds, 3.0)
        return {"answer": "I cannot say"} if seconds >= 3.0 else None

    monkeypatch.setattr(service_module, "ask_in_process", slow)
    monkeypatch.setattr(service_module, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=lambda s: None))
    with pytest.raises(ServiceError, match="the time limit of 10 s a plan"):
        ask(count=count, attempts=50, time_limit=10.0, retries=9, backoff=0.0)
    assert now[0] == 100.0 + 10.0 * count and max(asked) <= 10.0 * count


def test_a_service_that_stays_broken_is_given_up(reply, ask, server, provider):
    broken = reply(500, {"error": {"message": "internal error"}})
    with pytest.raises(ServiceError, match=re.escape(f"{provider}: gave up after 3 requests (500: internal error)")):
        ask(broken)
    assert len(server.requests) == 3


def test_a_server_that_is_not_there_is_said(ask):
    with pytest.raises(ServiceError, match="gave up after 2 requests") as caught:
        ask(GOOD, base_url="http://127.0.0.1:1", retries=1)
    assert "refused" in str(caught.value).lower()


@pytest.mark.parametrize("body", [{"error": {"message": "API key not valid. Please"}}, "API key not valid. Please"])
def test_a_key_that_is_called_wrong_with_status_400_is_said_to_be(reply, ask, body):
    with pytest.raises(ServiceError, match="the key in OPENAI_API_KEY is refused"):
        ask(reply(400, json.dumps([body])))  # Gemini's errors are lists


@pytest.mark.parametrize("status", [401, 403])
@both
def test_a_wrong_key_is_said_at_once_and_never_shown(reply, ask, server, provider, status):
    said = {"error": {"message": f"Incorrect API key provided: {KEY}"}}
    variable = ENDPOINTS[provider].key_variable
    message = f"{provider}: the key in {variable} is refused ({status}: Incorrect API key provided: <key>)"
    with pytest.raises(ServiceError, match=re.escape(message)) as caught:
        ask(reply(status, said))
    assert KEY not in str(caught.value) and len(server.requests) == 1


def test_a_request_that_is_wrong_is_not_repeated(reply, ask, server, provider):
    with pytest.raises(ServiceError, match=re.escape(f"{provider}: the request is refused (404: no such model)")):
        ask(reply(404, {"error": {"message": "no such model"}}))
    assert len(server.requests) == 1


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("<html>gateway</html>", "the reply is not JSON, found '<html>gateway</html>'"),
        ("", "the reply is not JSON, found ''"),
        ("[" * 100_000, "the reply is not JSON, found '[[[[["),
        ("9" * 5000, "the reply is not JSON, found '9999"),
        ("[1]", "the reply is not a JSON object, found list"),
        ("null", "the reply is not a JSON object, found NoneType"),
        ({"surprise": 1}, "the reply is not what the protocol says (choices[0].message), found surprise"),
        ({}, "(choices[0].message), found nothing"),
        ({"choices": None}, "(choices[0].message), found choices"),
        ({"choices": []}, "(choices[0].message), found choices"),
        ({"choices": {"0": 1}}, "(choices[0].message), found choices"),
        ({"choices": [3]}, "(choices[0].message), found choices"),
        ({"choices": [{"message": "hello"}]}, "(choices[0].message), found choices"),
        ({"choices": [{"message": {"content": 5}}]}, "the reply's message.content must be text, found int"),
        ({"choices": [{"message": {"content": {"text": "a"}}}]}, "message.content must be text, found dict"),
        ({"choices": [{"message": {"content": ["a"]}}]}, "the reply's message.content must be text, found list"),
        ({"choices": [{"message": {"content": [{"text": 5}]}}]}, "message.content must be text, found list"),
        ({"\x1b[31m": "\x1b]0;"}, "(choices[0].message), found ?[31m"),
        ("\x1b[31mred", "the reply is not JSON, found '?[31mred'"),
        ('{"choices": [{"message": {"content": "\\ud800 no"}}]}', "the reply is not JSON, found "),
        ("x" * 2**20 + "x", "the reply is longer than 1048576 bytes"),
    ],
)
def test_a_reply_that_is_no_reply_is_said_in_one_line(reply, ask, server, body, message):
    with pytest.raises((ServiceError, AnswerError), match=re.escape(message)) as caught:
        ask(reply(body=body))
    said = str(caught.value)
    assert said.isprintable() and len(said) < 300 and len(server.requests) == 1


def test_an_answer_in_parts_is_put_together(reply, ask):
    parts = [{"type": "text", "text": GOOD[:9]}, {"type": "text", "text": GOOD[9:]}, {"type": "other"}]
    assert torch.equal(ask(reply(body={"choices": [{"message": {"content": parts}}]})), ask(GOOD))


@pytest.mark.parametrize(
    "headers",
    [{"Content-Type": "text/html; charset=rot13"}, {"Content-Encoding": "gzip"}, {"Set-Cookie": "a=b"}],
)
def test_what_a_reply_says_of_itself_changes_nothing(reply, ask, headers):
    body = {"choices": [{"message": {"content": GOOD}}]}
    assert torch.equal(ask(reply(body=body, headers=headers)), ask(GOOD))


def test_a_redirect_is_not_followed_with_the_key(reply, ask, server):
    with pytest.raises(ServiceError, match=re.escape("the request is refused (307")):
        ask(reply(307, "", {"Location": f"{server.url}/elsewhere"}))
    assert len(server.requests) == 1


@both
def test_without_a_key_the_public_service_is_not_asked(provider, table, monkeypatch):
    variable = ENDPOINTS[provider].key_variable
    monkeypatch.delenv(variable, raising=False)
    planner = VLM(state_dim=3, horizon=20, dt=0.5, provider=provider)
    with pytest.raises(ServiceError, match=f"needs a key in the environment variable {variable}"):
        planner.sample(torch.zeros(3), table.goal, scene=table, count=1, generator=torch.Generator())


@pytest.mark.parametrize("key", [None, ""])
def test_a_server_of_ones_own_needs_no_key(ask, server, key):
    ask(GOOD, key=key)
    assert "authorization" not in server.requests[0]["headers"]


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("sk-12345\n67890", "the key in OPENAI_API_KEY must be visible ASCII characters without spaces or line breaks"),
        ("sk-1234567890\n", "the key in OPENAI_API_KEY must be visible ASCII characters without spaces or line breaks"),
        (" sk-1234567890", "the key in OPENAI_API_KEY must be visible ASCII characters without spaces or line breaks"),
        ("   ", "the key in OPENAI_API_KEY must be visible ASCII characters without spaces or line breaks"),
        ("ключ-1234567", "the key in OPENAI_API_KEY must be visible ASCII characters without spaces or line breaks"),
        ("clé-1234567", "the key in OPENAI_API_KEY must be visible ASCII characters without spaces or line breaks"),
        ("\udcff-1234567", "the key in OPENAI_API_KEY must be visible ASCII characters without spaces or line breaks"),
        (
            "\x1b[31m-1234567",
            "the key in OPENAI_API_KEY must be visible ASCII characters without spaces or line breaks",
        ),
        ("EMPTY", "the key in OPENAI_API_KEY has 5 characters, at least 8 are needed; unset it for a server that"),
    ],
)
def test_a_key_that_cannot_be_one_is_said_without_it(ask, server, key, message):
    with pytest.raises(ServiceError, match=re.escape(message)) as caught:
        ask(GOOD, key=key)
    assert key.strip() == "" or key not in str(caught.value)
    assert "12345" not in str(caught.value) and server.requests == []


def test_without_the_package_the_extra_is_named(ask, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ServiceError, match="'openai' needs the package openai; install sagemp with its extra 'vlm'"):
        ask(GOOD)


def test_an_answer_that_repeats_the_key_is_neither_kept_nor_shown_with_it(reply, ask, tmp_path):
    spelled = "".join(f"\\u{ord(c):04x}" for c in KEY)
    for said in (KEY, spelled, base64.b64encode(KEY.encode()).decode()):
        folder = tmp_path / str(len(said))
        with pytest.raises(AnswerError) as caught:
            ask(f'{{"{said}": 1}}', cache=str(folder))
        (entry,) = folder.iterdir()
        assert "<key>" in entry.read_text() and "<key>" in str(caught.value)
        assert said not in entry.read_text() + str(caught.value) and KEY not in entry.read_text() + str(caught.value)


def test_the_cache_answers_again_without_the_service(reply, ask, server, tmp_path):
    folder = tmp_path / "cache"
    other = '{"waypoints": [[0.0, -0.6]]}'
    first = ask(GOOD, other, count=2, cache=str(folder))
    assert not torch.equal(first[0], first[1]) and len(list(folder.iterdir())) == 2
    server.requests.clear()
    again = ask(reply(500), count=2, cache=str(folder), retries=0)
    assert torch.equal(first, again) and not server.requests
    kept = [json.loads(path.read_text()) for path in folder.iterdir()]
    assert {entry["model"] for entry in kept} == {"gpt-4o"} and all(len(entry["prompt_hash"]) == 64 for entry in kept)
    assert {entry["answers"][0] for entry in kept} == {GOOD, other}


def test_the_cache_can_be_replayed_and_says_who_answered(ask, table, tmp_path):
    folder = tmp_path / "cache"
    asked = ask(GOOD, cache=str(folder), model="vendor/model-1")
    about = {"state_dim": 3, "horizon": 20, "dt": 0.5, "provider": "replay", "recording": str(folder)}
    replay = VLM(**about, prompt="over_burger")
    again = replay.sample(START, table.goal, scene=table, count=1, generator=torch.Generator())
    assert torch.equal(asked, again)
    assert re.fullmatch(r"VLM planner, replay of cache \(vendor/model-1, \d{4}-\d\d-\d\d\)", replay.label)
    with pytest.raises(UsageError, match="its answers were given to another prompt than planner.prompt"):
        other = VLM(**about, prompt="avoid_food")
        other.sample(START, table.goal, scene=table, count=1, generator=torch.Generator())


def test_the_cache_is_not_asked_for_another_seed_model_or_prompt(ask, server, tmp_path):
    folder = str(tmp_path / "cache")
    ask(GOOD, cache=folder)
    for change in ({"seed": 1}, {"model": "other"}, {"prompt": "avoid_food"}, {"image_height": 40}):
        server.requests.clear()
        ask(GOOD, cache=folder, **change)
        assert len(server.requests) == 1, change


def test_a_damaged_cache_entry_is_named(ask, tmp_path):
    folder = tmp_path / "cache"
    ask(GOOD, cache=str(folder))
    (entry,) = folder.iterdir()
    entry.write_text("{")
    with pytest.raises(UsageError, match=re.escape(f"{entry}: a recording must be JSON")):
        ask(GOOD, cache=str(folder))


@pytest.mark.parametrize(
    ("service", "message"),
    [
        ({"base_url": "file:///etc/passwd"}, "planner.service.base_url must begin with http:// or https://"),
        (
            {"base_url": "http://user:pw@127.0.0.1"},
            "planner.service.base_url must hold no user, password or parameters",
        ),
        (
            {"base_url": "http://127.0.0.1/?key=abc"},
            "planner.service.base_url must hold no user, password or parameters",
        ),
        ({"base_url": "http://127.0.0.1:port"}, "planner.service.base_url is no address"),
        ({"base_url": "http://"}, "planner.service.base_url must begin with http:// or https://"),
        ({"timeout": 0.0}, "timeout and time_limit must be positive seconds"),
        ({"retries": -1}, "retries and temperature must not be negative"),
        ({"modle": "x"}, "planner.service.modle: no such option (did you mean 'model'?)"),
    ],
)
def test_wrong_options_of_a_service_are_named(service, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        build({"name": "vlm", "provider": "openai", "service": service}, "planner", state_dim=3, horizon=20, dt=0.5)
