"""One request: the key is taken out of whatever comes back, and the process ends in time whatever the server does."""

from __future__ import annotations

import base64
import html
import importlib.util
import json
import os
import random
import signal
import subprocess
import threading
import time
import urllib.parse
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from sagemp_cli.planners.vlm import request
from sagemp_cli.planners.vlm.request import ask, ask_in_process, redacted

HOSTILE_SERVICE = Path(__file__).parents[3] / "benchmarks" / "hostile_service.py"
spec = importlib.util.spec_from_file_location("hostile_service", HOSTILE_SERVICE)
assert spec is not None and spec.loader is not None
hostile_service = importlib.util.module_from_spec(spec)
spec.loader.exec_module(hostile_service)

KEY = hostile_service.KEY


def request_to(base_url: str, **changes: object) -> dict:
    png = base64.b64encode(b"\x89PNG").decode()
    about = {"base_url": base_url, "key": KEY, "model": "m", "text": "go", "png": png, "temperature": 1.0, "seed": 1}
    return about | changes


def children() -> list[psutil.Process]:
    """Processes that ask; those of other tests (who read files, track shared memory) may wait for more of them."""
    return [p for p in psutil.Process().children(recursive=True) if request.__file__ in p.cmdline()]


SPELLINGS = {
    "plain": KEY,
    "lower case": KEY.lower(),
    "URL": urllib.parse.quote(KEY),
    "URL, twice": urllib.parse.quote(urllib.parse.quote(KEY, safe="")),
    "every character in percent": "".join(f"%{ord(c):02X}" for c in KEY),
    "HTML": html.escape(KEY),
    "HTML numbers": "".join(f"&#x{ord(c):X};" for c in KEY),
    "JSON": json.dumps(KEY)[1:-1],
    "JSON in JSON": json.dumps(json.dumps(KEY))[1:-1],
    "JSON in JSON in JSON": json.dumps(json.dumps(json.dumps(json.dumps(KEY)))),
    "JSON escapes": "".join(f"\\u{ord(c):04x}" for c in KEY),
    "JSON escapes in JSON": "".join(f"\\\\u{ord(c):04X}" for c in KEY),
    "Python bytes": repr(KEY.encode()),
    "folded": "\r\n  ".join([KEY[:6], KEY[6:]]),
    "NULs between": "\0".join(KEY),
    "UTF-7": KEY.encode("utf-7").decode(),
    "hex": KEY.encode().hex().upper(),
    "base64": base64.b64encode(KEY.encode()).decode(),
    "base64 for URLs": base64.urlsafe_b64encode(KEY.encode()).decode(),
    "base64 of user and key": base64.b64encode(f"user:{KEY}".encode()).decode(),
    "base64 of a longer user and key": base64.b64encode(f"user1:{KEY}:".encode()).decode(),
    "base64 of the longest user and key": base64.b64encode(f"user12:{KEY};".encode()).decode(),
}


@pytest.mark.parametrize("way", SPELLINGS)
def test_the_key_is_taken_out_however_it_is_written(way):
    found = redacted(f"your key {SPELLINGS[way]} is wrong", KEY)
    assert "<key>" in found and not hostile_service.shows_key(found)
    assert found.startswith("your key ") and found.endswith(" is wrong")


def test_a_text_without_the_key_stays_as_it_is():
    text = json.dumps({"waypoints": [[0.1, -0.2]], "why": KEY[:-1] + " \\u0041 %41"})
    assert redacted(text, KEY) == text and redacted(text, "") == text


@pytest.mark.parametrize("piece", ["\\", KEY[:4], KEY[0] + " ", "&#0", "%25", "x", "\\u00", "\0"])
def test_taking_the_key_out_of_a_megabyte_takes_a_moment(piece):
    began = time.perf_counter()
    redacted(piece * (2**20 // len(piece)), KEY)
    assert time.perf_counter() - began < 10  # 0.4 s on an idle core; a pattern that backtracks takes hours


@pytest.mark.parametrize("kind", [kind for kind in hostile_service.QUICK if kind != "compressed bomb"])
def test_whatever_a_server_says_is_one_of_four_outcomes_without_the_key(kind):
    for seed in (0, 1):
        make = hostile_service.QUICK[kind]
        with hostile_service.hostile(lambda make=make, seed=seed: make(random.Random(seed))) as (at, lines):
            outcome = ask(request_to(f"http://{at}"))
        assert len({"answer", "status", "lost", "wrong"} & set(outcome)) == 1
        assert not hostile_service.shows_key(json.dumps(outcome)) and len(json.dumps(outcome)) < 8 * 2**20
        assert [line for line in lines if not line.startswith("POST /chat/completions ")] == []


def test_a_compressed_reply_is_not_unpacked():
    with hostile_service.hostile(lambda: hostile_service.QUICK["compressed bomb"](random.Random(0))) as (at, _):
        outcome = ask(request_to(f"http://{at}"))
    assert outcome["wrong"].startswith("the reply is not JSON")


def test_an_answer_comes_out_of_the_process_and_the_key_does_not():
    said = hostile_service.completion(f"{hostile_service.GOOD} {KEY}")
    with hostile_service.hostile(lambda: hostile_service.reply(said)) as (at, lines):
        outcome = ask_in_process(request_to(f"http://{at}/v1"), 60.0)
    assert outcome == {"answer": f"{hostile_service.GOOD} <key>"}
    assert lines == ["POST /v1/chat/completions HTTP/1.1"] and children() == []


def test_the_package_s_own_settings_in_the_environment_do_not_count(monkeypatch, tmp_path):
    monkeypatch.setenv("OPENAI_BASE_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("OPENAI_API_KEY", "another-key")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "openai.py").write_text("raise SystemExit(9)")
    reply = hostile_service.completion("hello")
    with hostile_service.hostile(lambda: hostile_service.reply(reply)) as (at, _):
        assert ask_in_process(request_to(f"http://{at}"), 60.0) == {"answer": "hello"}


TIMED = ["silent", "dripped status line", "dripped chunk extension", "dripped trailers", "endless 100 Continue"]


def test_replies_that_never_end_and_handshakes_that_never_begin_end_in_time():
    def seconds_of(kind: str) -> tuple[float, object]:
        scheme = "https" if kind == "silent" else "http"
        with hostile_service.hostile(lambda: hostile_service.SLOW[kind](random.Random(0))) as (at, _):
            began = time.monotonic()
            outcome = ask_in_process(request_to(f"{scheme}://{at}"), 2.5)
            return time.monotonic() - began, outcome

    with ThreadPoolExecutor(len(TIMED)) as pool:
        found = dict(zip(TIMED, pool.map(seconds_of, TIMED), strict=True))
    assert all(seconds < 6 for seconds, _ in found.values()), found
    assert all(outcome is None for _, outcome in found.values()), found
    assert children() == []


def test_ctrl_c_ends_a_request_and_its_process():
    with hostile_service.hostile(lambda: hostile_service.silent(random.Random(0))) as (at, _):
        seen = []

        def interrupt() -> None:
            while not children():
                time.sleep(0.05)
            seen.extend(children())
            os.kill(os.getpid(), signal.SIGINT)

        timer = threading.Timer(0.3, interrupt)
        timer.daemon = True
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            ask_in_process(request_to(f"http://{at}"), 60.0)
        timer.join()
    assert len(seen) == 1 and children() == []


def test_the_key_is_no_argument_of_the_process(monkeypatch):
    seen: list[object] = []

    def start(command, **options):
        seen.extend([*command, *options["env"].values()])
        return Popen(command, **options)

    Popen = subprocess.Popen
    monkeypatch.setattr("subprocess.Popen", start)
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    ask_in_process(request_to("http://127.0.0.1:1"), 0.1)
    assert seen and all(KEY not in os.fspath(entry) for entry in seen)
