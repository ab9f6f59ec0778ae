"""A hostile vision-language service on loopback: what it answers, by kind; ``hostile_campaign.py`` asks it."""

from __future__ import annotations

import base64
import functools
import gzip
import html
import json
import random
import re
import socket
import threading
import time
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

KEY = "sk-Zr/7+q&N\"x'%t-_Q9"
"""With characters that every way of writing escapes."""
GOOD = '{"waypoints": [[-0.3, -0.3], [0.3, -0.4]]}'
Pieces = Iterator[bytes]
OK = b"HTTP/1.1 200 OK\r\n"


def spellings(rng: random.Random) -> str:
    """The key as a server may write it."""
    ways: list[Callable[[str], str]] = [
        str,
        str.lower,
        urllib.parse.quote,
        html.escape,
        lambda k: json.dumps(k)[1:-1],
        lambda k: json.dumps(json.dumps(k))[1:-1],
        lambda k: "".join(f"\\u{ord(c):04x}" for c in k),
        lambda k: "".join(f"%{ord(c):02X}" for c in k),
        lambda k: base64.b64encode(k.encode()).decode(),
        lambda k: base64.b64encode(f"u:{k}:x".encode()).decode(),
        lambda k: k.encode().hex(),
        lambda k: "\r\n ".join([k[:7], k[7:]]),
        lambda k: repr(k.encode()),
    ]
    return rng.choice(ways)(KEY)


def shows_key(text: str) -> bool:
    """Whether the key stands in a text, also after undoing what a writer may have done to it."""
    forms = {text}
    for _ in range(3):
        forms |= {urllib.parse.unquote(t) for t in forms} | {html.unescape(t) for t in forms}
        forms |= {re.sub(r"\\u00([0-9a-fA-F]{2})|\\(.)", _unescape, t) for t in forms}
    for word in re.findall(r"[A-Za-z0-9+/_-]{16,}", text):
        for cut in range(4):
            with suppress(ValueError):
                piece = word[cut:]
                piece = piece[: len(piece) // 4 * 4].replace("-", "+").replace("_", "/")
                forms.add(base64.b64decode(piece).decode("latin-1"))
        with suppress(ValueError):
            forms.add(bytes.fromhex(word).decode("latin-1"))
    needles = (KEY.lower(), KEY.lower()[:12], KEY.lower()[-12:])
    return any(needle in re.sub(r"\s", "", form.lower()) for form in forms for needle in needles)


def _unescape(match: re.Match[str]) -> str:
    return chr(int(match.group(1), 16)) if match.group(1) else match.group(2)


def reply(body: bytes | str, *, status: str = "200 OK", head: str = "") -> Pieces:
    """A well-formed reply."""
    sent = body.encode("utf-8", "surrogatepass") if isinstance(body, str) else body
    yield f"HTTP/1.1 {status}\r\n{head}Content-Length: {len(sent)}\r\n\r\n".encode("utf-8", "replace") + sent


def completion(content: object) -> str:
    """The JSON of a well-formed completion."""
    return json.dumps({"choices": [{"message": {"role": "assistant", "content": content}}]})


def dripped(beginning: bytes, rest: bytes, every: float = 0.05) -> Pieces:
    """``rest`` again and again, a byte at a time."""
    yield beginning
    while True:
        for byte in rest:
            time.sleep(every)
            yield bytes([byte])


def endless(beginning: bytes, rest: bytes) -> Pieces:
    """``rest`` again and again, as fast as it is taken."""
    yield beginning
    while True:
        yield rest


def silent(_: random.Random) -> Pieces:
    """Nothing, for ever."""
    while True:
        time.sleep(0.05)
        yield b""


CHUNKED = OK + b"Transfer-Encoding: chunked\r\n\r\n"
SLOW: dict[str, Callable[[random.Random], Pieces]] = {
    "silent": silent,
    "dripped status line": lambda r: dripped(b"HTTP/1.1 200 ", b"O"),
    "dripped header": lambda r: dripped(OK + b"X: ", b"a"),
    "dripped headers": lambda r: dripped(OK, b"A: b\r\n"),
    "dripped chunk extension": lambda r: dripped(CHUNKED + b"5;", b"a"),
    "dripped chunks": lambda r: dripped(CHUNKED, b"1\r\na\r\n"),
    "dripped body": lambda r: dripped(OK + b"Content-Length: 999999\r\n\r\n", b" "),
    "dripped error body": lambda r: dripped(b"HTTP/1.1 500 No\r\nContent-Length: 999999\r\n\r\n", b"a"),
    "dripped trailers": lambda r: dripped(CHUNKED + b"2\r\n{}\r\n0\r\n", b"A: b\r\n"),
    "dripped 100 Continue": lambda r: dripped(b"", b"HTTP/1.1 100 Continue\r\n\r\n", 0.005),
    "endless 100 Continue": lambda r: endless(b"", b"HTTP/1.1 100 Continue\r\n\r\n" * 50),
    "endless early hints": lambda r: endless(b"", b"HTTP/1.1 103 Hints\r\nLink: a\r\n\r\n" * 50),
    "endless empty chunk extensions": lambda r: endless(CHUNKED, b"1;a=b\r\na\r\n" * 10),
}
"""Kinds of answers that never end."""


def wild_json(rng: random.Random, depth: int = 4) -> object:
    """Anything."""
    leaves = [None, True, 5, -1e308, 10**30, "", "a", spellings(rng), "\x1b[31m", "\ud800", [], {}, GOOD, float("nan")]
    if depth == 0 or rng.random() < 0.3:
        return rng.choice(leaves)
    if rng.random() < 0.5:
        return [wild_json(rng, depth - 1) for _ in range(rng.randint(0, 3))]
    names = ["choices", "message", "content", "text", "error", "refusal", "waypoints", spellings(rng), "\x1b]0;x\x07"]
    return {rng.choice(names): wild_json(rng, depth - 1) for _ in range(rng.randint(0, 3))}


def wild_completion(rng: random.Random) -> str:
    """A completion with one part replaced."""
    tree = json.loads(completion(GOOD))
    spot: object = tree
    path = rng.choice([["choices"], ["choices", 0], ["choices", 0, "message"], ["choices", 0, "message", "content"]])
    for step in path[:-1]:
        spot = spot[step]
    spot[path[-1]] = wild_json(rng)
    return json.dumps(tree)


def wild_text(rng: random.Random) -> str:
    """An answer's text that a parser may dislike."""
    return rng.choice(
        [
            "[" * rng.randint(10, 90_000),
            '["]",' * 15_000,
            '{"waypoints": [[' + "9" * rng.choice([300, 4000, 90_000]) + ", 0]]}",
            '{"waypoints": [[NaN, 1e999]]}',
            '{"waypoints": ' + json.dumps(wild_json(rng)) + "}",
            '{"waypoints": [' + "[0.1,0.2]," * 9000,
            "[" * 99 + "[]," * 30_000,
            "\x1b]0;owned\x07\x1b[2J I cannot",
            f"I cannot, my key is {spellings(rng)}",
            f'{{"{spellings(rng)}": 1}}',
            f'{{"waypoints": [["{spellings(rng)}", 0]]}}',
            "x" * rng.choice([99_999, 100_001, 900_000]),
            "\ud800\udfff\x00\u202e",
            GOOD,
        ]
    )


def wild_status(rng: random.Random) -> str:
    """A status line's end."""
    code = rng.choice(["0", "99", "101", "200", "204", "304", "307", "400", "401", "429", "500", "503", "600", "1000"])
    return f"{code} {rng.choice(['OK', '', spellings(rng).replace(chr(13), ''), chr(27) + '[31m'])}"


def wild_head(rng: random.Random) -> str:
    """Headers."""
    retry = rng.choice(["1e999", "9" * 4000, "nan", "-1", "Fri, 31 Dec 999999999 23:59:59 GMT", "0x10", spellings(rng)])
    name = re.sub(r"[^A-Za-z0-9-]", "-", spellings(rng))
    return "".join(
        rng.sample(
            [
                f"Retry-After: {retry}\r\n",
                f"X-{name}: {spellings(rng)}\r\n",
                "Content-Type: text/html; charset=rot13\r\n",
                "Content-Type: application/json; charset=\x1b[31m\r\n",
                "Content-Encoding: gzip\r\n",
                f"Set-Cookie: a={spellings(rng)}; Domain=127.0.0.1\r\n",
                "Content-Length: 3\r\n",
                "Content-Length: -1\r\n",
                "Transfer-Encoding: identity, chunked\r\n",
                "Upgrade: h2c\r\nConnection: Upgrade\r\n",
            ],
            rng.randint(0, 3),
        )
    )


@functools.cache
def bomb() -> bytes:
    """A small body that unpacks into 128 MiB."""
    return gzip.compress(b" " * 2**27, 9)


QUICK: dict[str, Callable[[random.Random], Pieces]] = {
    "closed at once": lambda r: iter([]),
    "garbage": lambda r: iter([r.randbytes(r.choice([1, 100, 70_000]))]),
    "another protocol": lambda r: iter(
        [r.choice([b"SSH-2.0-x\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"\x16\x03\x01"])]
    ),
    "status line of a megabyte": lambda r: iter([b"HTTP/1.1 200 " + b"a" * 2**20]),
    "key in a broken status line": lambda r: iter([f"HTTP/1.1 {spellings(r)}\r\n\r\n".encode()]),
    "headers of megabytes": lambda r: iter([OK + b"A: b\r\n" * 2**18]),
    "body of gigabytes": lambda r: endless(OK + b"Content-Length: 99999999999\r\n\r\n", b"a" * 2**16),
    "error body of gigabytes": lambda r: endless(b"HTTP/1.1 503 No\r\n\r\n", b"a" * 2**16),
    "chunks of gigabytes": lambda r: endless(CHUNKED, b"10000\r\n" + b" " * 2**16 + b"\r\n"),
    "a chunk of exabytes": lambda r: iter([CHUNKED + b"F" * r.choice([15, 16, 17, 4000]) + b"\r\na"]),
    "compressed bomb": lambda r: reply(bomb(), head="Content-Encoding: gzip\r\n"),
    "body cut off": lambda r: iter([OK + b"Content-Length: 900\r\n\r\n" + completion(GOOD).encode()]),
    "deep JSON": lambda r: reply(r.choice(["[", '{"a":', '{"choices":[']) * r.choice([500, 5000, 150_000])),
    "long numbers": lambda r: reply('{"choices": ' + "9" * r.choice([300, 5000, 900_000]) + "}"),
    "many choices": lambda r: reply('{"choices": [' + ",".join(["{}"] * 300_000) + "]}"),
    "redirect to itself": lambda r: reply("", status="307 Go", head=f"Location: /{urllib.parse.quote(KEY)}\r\n"),
    "any JSON": lambda r: reply(json.dumps(wild_json(r, 6)), status=wild_status(r), head=wild_head(r)),
    "any completion": lambda r: reply(wild_completion(r)),
    "any completion and head": lambda r: reply(wild_completion(r), status=wild_status(r), head=wild_head(r)),
    "any answer": lambda r: reply(completion(wild_text(r))),
    "key in an error": lambda r: reply(
        json.dumps({"error": {"message": f"no such key: {spellings(r)}"}}), status=wild_status(r), head=wild_head(r)
    ),
    "key in a page": lambda r: reply(f"<h1>{spellings(r)}</h1>", status=wild_status(r), head=wild_head(r)),
    "key in another encoding": lambda r: reply(f"key {KEY}".encode(r.choice(["utf-16", "utf-32", "utf-7"]))),
}
"""Kinds of answers that end, or that are too much soon."""


@contextmanager
def hostile(make: Callable[[], Pieces]) -> Iterator[tuple[str, list[str]]]:
    """A server on loopback that answers every request so: its address, and the first lines of the requests."""
    lines: list[str] = []
    closing = threading.Event()
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(0.05)

    def serve() -> None:
        while not closing.is_set():
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            with connection, suppress(OSError):
                connection.settimeout(0.5)
                lines.append(connection.recv(2**16).split(b"\r\n")[0].decode("latin-1"))
                with suppress(TimeoutError):  # the rest of the question, or a close would reset the connection
                    while connection.recv(2**20):
                        connection.settimeout(0.05)
                connection.settimeout(0.2)
                for piece in make():
                    if closing.is_set():
                        break
                    connection.sendall(piece)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{listener.getsockname()[1]}", lines
    finally:
        closing.set()
        thread.join()
        listener.close()
