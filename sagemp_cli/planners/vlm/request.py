"""One question to an OpenAI-compatible server, by the ``openai`` package, in a process that is killed when it is late.

No timeout of an HTTP client bounds a request: each read has one, and a server that sends a byte now and then (a status
line, a header, trailers, "100 Continue" again and again) is never late; a name look-up and a TLS handshake have none.
So :func:`ask_in_process` starts this very file as a script and kills it at the deadline, which ends whatever it is in.
The script imports nothing of sagemp: it starts in half a second.

What the server says is untrusted, and the key is taken out of all of it here, before anything else is made of it:
:func:`ask` gives no text in which the key could stand.
"""

from __future__ import annotations

import base64
import html
import json
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from typing import Any

LONGEST_REPLY = 2**20
"""Bytes of a reply that are read."""
MOST_MEMORY = 2**31
"""Bytes of address space that the process may have, where the system can limit it."""

Outcome = dict[str, Any]
"""One of ``{"answer": text}``, ``{"status": code, "message": text, "retry_after": text or None}``, ``{"lost": why}``
(no reply; another try may help) and ``{"wrong": what}`` (a reply that is none)."""


def ask_in_process(request: dict[str, Any], seconds: float) -> Outcome | None:
    """What :func:`ask` gives, from a process that lives at most ``seconds``; None if it was late and killed."""
    # -P: the script's own folder is no place to import from. The key goes by the pipe, and no setting of the
    # package's in the environment (another address, a log of requests) counts.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("OPENAI_")}
    command = [sys.executable, "-P", __file__]
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        try:
            said, _ = process.communicate(json.dumps(request | {"seconds": seconds}).encode(), timeout=seconds)
        except subprocess.TimeoutExpired:
            return None
        finally:  # also after Ctrl-C
            process.kill()
            process.wait()
    try:
        return json.loads(said)
    except ValueError:
        return {"lost": f"the process that asked ended with code {process.returncode}"}


def ask(request: dict[str, Any]) -> Outcome:
    """Ask once: ``base_url``, ``key`` ("" for none), ``model``, ``text``, ``png`` (base64), ``temperature``, ``seed``.

    A ``seed`` of None is not sent. No redirect is followed: it would carry the key somewhere else.
    """
    import openai  # only here: half a second, and an optional package

    class Bounded(openai.DefaultHttpxClient):
        """Reads a reply up to a limit, undecoded (no compression was asked for); keeps what is needed of its head."""

        def send(self, request: Any, **options: Any) -> Any:
            options |= {"stream": True, "follow_redirects": False}
            response = super().send(request, **options)
            parts, size = [], 0
            try:
                for part in response.iter_raw():
                    parts.append(part)
                    size += len(part)
                    if size > LONGEST_REPLY:
                        raise _TooLong
            finally:
                response.close()
            kept = {name: v for name, v in response.headers.items() if name.lower() == "retry-after"}
            kept["content-type"] = "application/json"  # whatever it says of itself: it is read as JSON
            return type(response)(response.status_code, headers=kept, content=b"".join(parts), request=request)

    key = request["key"]
    image = {"type": "image_url", "image_url": {"url": f"data:image/png;base64,{request['png']}"}}
    messages: Any = [{"role": "user", "content": [{"type": "text", "text": request["text"]}, image]}]
    seed: dict[str, Any] = {} if request["seed"] is None else {"seed": request["seed"]}
    # The package insists on a key; where there is none, none is sent.
    head = {"Accept-Encoding": "identity"} | ({} if key else {"Authorization": openai.Omit()})
    try:
        with openai.OpenAI(
            api_key=key or "none", base_url=request["base_url"], timeout=None, max_retries=0, http_client=Bounded()
        ) as client:
            reply = client.chat.completions.with_raw_response.create(
                model=request["model"],
                messages=messages,
                temperature=request["temperature"],
                extra_headers=head,
                **seed,
            )
        outcome = _answer(redacted(reply.content.decode("utf-8", "replace"), key))
    except openai.APIStatusError as e:
        body = redacted(e.response.content.decode("utf-8", "replace"), key)
        retry_after = e.response.headers.get("retry-after")
        outcome = {"status": e.status_code, "message": _message(body), "retry_after": retry_after}
    except openai.APIConnectionError as e:
        cause = e.__cause__ or e
        outcome = {"lost": str(cause) or type(cause).__name__}
    except _TooLong:
        outcome = {"wrong": f"the reply is longer than {LONGEST_REPLY} bytes"}
    except Exception as e:  # whatever a hostile reply leads the package to: one line, never a traceback
        outcome = {"wrong": f"the reply cannot be read ({type(e).__name__})"}
    return {name: redacted(value, key) if isinstance(value, str) else value for name, value in outcome.items()}


def redacted(text: str, key: str) -> str:
    """A text with ``<key>`` in place of the key, also where it is escaped as in JSON, URLs or HTML, base64 or hex."""
    if not key:
        return text
    spelled = r"[\s\x00-\x1f\x7f\u200b-\u200f\u2060\ufeff\ufffd]*".join(
        _spellings(c, first=i == 0) for i, c in enumerate(key)
    )
    raw = key.encode()
    encoded = {raw.hex()}
    for shift in range(3):  # of the key after other bytes, as in "user:key"; only characters that it alone decides
        inside = slice((shift * 8 + 5) // 6, (shift + len(raw)) * 8 // 6)
        for code in (base64.b64encode, base64.urlsafe_b64encode):
            encoded.add(code(b"\0" * shift + raw).decode()[inside])
    return re.sub("|".join([spelled, *map(re.escape, sorted(encoded))]), "<key>", text, flags=re.IGNORECASE)


def _spellings(c: str, *, first: bool) -> str:
    """A pattern for one character, plain or escaped; repetitions are bounded or begin in one place: it stays linear."""
    plain = {re.escape(c), re.escape(html.escape(c))} | ({r"\+-"} if c == "+" else set())  # as in UTF-7
    plain |= {rf"(?:u00|x){ord(c):02x}"}
    backslashes = r"(?<!\\)\\*" if first else r"\\{0,16}"
    before = "" if c == "\\" else backslashes
    escaped = [rf"%(?:25){{0,3}}{ord(c):02x}", rf"&\#(?:0{{0,4}}{ord(c)}|x0{{0,4}}{ord(c):x});"]
    return f"(?:{before}(?:{'|'.join(sorted(plain, reverse=True))})|{'|'.join(escaped)})"


class _TooLong(Exception):
    """More bytes than are read."""


def _parsed(text: str) -> Any:
    """JSON, by a parser with a limit of its own on depth: whoever shares the process may have moved Python's. Text that
    is no Unicode (half a surrogate pair) is refused too.
    """
    from pydantic_core import from_json  # comes with openai

    return from_json(text)


def _answer(text: str) -> Outcome:
    """The answer in a reply's text: every type is looked at before it is relied on."""
    try:
        reply = _parsed(text)
    except ValueError:
        return {"wrong": f"the reply is not JSON, found '{text[:60]}'"}
    if not isinstance(reply, dict):
        return {"wrong": f"the reply is not a JSON object, found {type(reply).__name__}"}
    choices = reply.get("choices")
    choice = choices[0] if isinstance(choices, list) and choices else None
    choice = choice if isinstance(choice, dict) else {}
    message = choice.get("message")
    if not isinstance(message, dict):
        keys = ", ".join(reply)[:60] or "nothing"
        return {"wrong": f"the reply is not what the protocol says (choices[0].message), found {keys}"}
    refusal, content, ended = message.get("refusal"), message.get("content"), choice.get("finish_reason")
    if isinstance(refusal, str) and refusal:
        return {"answer": f"refused by the model: cannot answer ({refusal})"}
    if isinstance(content, list):  # some servers give the text in parts
        parts = [part.get("text", "") if isinstance(part, dict) else None for part in content]
        texts = [part for part in parts if isinstance(part, str)]
        content = "".join(texts) if len(texts) == len(parts) else content
    if content is None and ended == "content_filter":
        return {"answer": "refused by the service: cannot answer (content_filter)"}
    if content is not None and not isinstance(content, str):
        return {"wrong": f"the reply's message.content must be text, found {type(content).__name__}"}
    return {"answer": content or ""}


def _message(text: str) -> str:
    """What a service says of an error: its ``error.message``, else all of it."""
    with suppress(ValueError):
        said = _parsed(text)
        said = said[0] if isinstance(said, list) and said else said  # as Gemini has it
        said = said.get("error", said) if isinstance(said, dict) else said
        said = said.get("message", said) if isinstance(said, dict) else said
        text = said if isinstance(said, str) else text
    return text


def _main() -> None:
    request = json.load(sys.stdin)
    if hasattr(signal, "setitimer"):  # if nobody is left to kill it
        signal.setitimer(signal.ITIMER_REAL, request["seconds"] + 1)
    with suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    json.dump(ask(request), sys.stdout)


if __name__ == "__main__":
    _main()
