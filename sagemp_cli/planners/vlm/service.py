"""A vision-language model behind a network: one careful HTTPS request, repeated where that can help, and a cache."""

from __future__ import annotations

import hashlib
import http.client
import json
import math
import os
import time
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

import torch

from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.planners.vlm.question import Question
from sagemp_cli.storage.atomic import write_whole

TEMPORARY = (408, 429, 500, 502, 503, 504)
"""HTTP statuses after which the same request may succeed."""
LONGEST_REPLY = 2**22
"""Bytes of a reply that are read."""


class ServiceError(UsageError):
    """A service that cannot be used: no key, a refused key, out of reach, too slow, or a reply that is none."""


@dataclass(frozen=True)
class ServiceOptions:
    """How a service is called.

    Attributes:
        model: its name there; None for the dialect's default.
        base_url: where the service is; None for the dialect's public one.
        temperature: of the sampling.
        image_height: pixels of the picture that is sent.
        timeout: seconds that one request may take.
        time_limit: seconds that a question may take with all repetitions and pauses.
        retries: repetitions after a temporary failure.
        backoff: seconds before the first repetition; doubled each time; a service's Retry-After counts if longer.
        cache: folder of answers, by what was asked; None keeps none.
    """

    model: str | None = None
    base_url: str | None = None
    temperature: float = 1.0
    image_height: int = 768
    timeout: float = 60.0
    time_limit: float = 300.0
    retries: int = 5
    backoff: float = 1.0
    cache: str | None = None

    def __post_init__(self) -> None:
        if not (0 < self.timeout < math.inf and 0 < self.time_limit < math.inf and 0 <= self.backoff < math.inf):
            raise ConfigError(
                "planner.service: timeout and time_limit must be positive seconds, backoff not negative, "
                f"found {self.timeout}, {self.time_limit} and {self.backoff}"
            )
        if self.retries < 0 or self.image_height < 16 or not 0 <= self.temperature < math.inf:
            raise ConfigError(
                "planner.service: retries and temperature must not be negative, image_height at least 16, "
                f"found {self.retries}, {self.temperature} and {self.image_height}"
            )
        if self.base_url is not None and urlsplit(self.base_url).scheme not in ("http", "https"):
            raise ConfigError(f"planner.service.base_url must begin with http:// or https://, found '{self.base_url}'")


class Dialect(Protocol):
    """What differs between services: how a question and its answer are written down.

    Attributes:
        name: of the provider.
        key_variable: environment variable that holds the key.
        base_url: of the public service.
        model: the default one.
    """

    name: str
    key_variable: str
    base_url: str
    model: str

    def request(
        self, base_url: str, model: str, key: str, *, text: str, png: bytes, temperature: float, seed: int
    ) -> tuple[str, dict[str, str], dict[str, Any]]:
        """Address, headers and body of the request for one answer."""

    def answer(self, reply: Mapping[str, Any]) -> str:
        """The text of a reply; empty if the model gave none."""


@dataclass(frozen=True)
class Service:
    """A provider that asks a service.

    The key comes from the environment and nowhere else: it is in no config, no artifact, no cache and no message.

    Attributes:
        dialect: how the service is spoken to.
        options: address, model and limits.
    """

    dialect: Dialect
    options: ServiceOptions

    @property
    def model(self) -> str:
        """The model that is asked."""
        return self.options.model or self.dialect.model

    @property
    def label(self) -> str:
        """What answers, for figures."""
        return f"{self.dialect.name}: {self.model}"

    def answers(self, questions: Sequence[Question], *, generator: torch.Generator) -> list[str]:
        """One answer per question; equal questions get a seed each, so answers may differ.

        The seeds come from ``generator``, so a run that is repeated asks the same and finds its answers in the cache.

        Raises:
            ServiceError: there is no answer to be had.
        """
        seeds = torch.randint(2**31 - 1, (len(questions),), generator=generator).tolist()
        return [self._answer(question, seed) for question, seed in zip(questions, seeds, strict=True)]

    def _answer(self, question: Question, seed: int) -> str:
        png = question.png(self.options.image_height)
        path = self._cached(question.text, png, seed)
        if path is not None and path.exists():
            return _read_cached(path)
        base_url = (self.options.base_url or self.dialect.base_url).rstrip("/")
        key = os.environ.get(self.dialect.key_variable, "").strip()
        if not key and self.options.base_url is None:
            raise ServiceError(
                f"planner.provider '{self.dialect.name}' needs a key in the environment variable "
                f"{self.dialect.key_variable}; without one use planner.provider=local (a stand-in) or replay"
            )
        url, headers, body = self.dialect.request(
            base_url, self.model, key, text=question.text, png=png, temperature=self.options.temperature, seed=seed
        )
        reply = _Call(self.dialect, self.options, key).reply(url, headers, body)
        try:
            answer = self.dialect.answer(reply)
        except (KeyError, IndexError, TypeError, AttributeError):
            keys = ", ".join(map(str, reply)) or "nothing"
            raise ServiceError(f"{self.dialect.name}: the reply is not what the protocol says, found {keys}") from None
        if path is not None:
            record = {"model": self.model, "seed": seed, "prompt": question.text, "answer": answer}
            write_whole(path, json.dumps(record, indent=1).encode(), overwrite=True)
        return answer

    def _cached(self, text: str, png: bytes, seed: int) -> Path | None:
        """Where the answer to a question is kept: by a hash of all that could change it."""
        if self.options.cache is None:
            return None
        asked = [self.dialect.name, self.options.base_url, self.model, self.options.temperature, seed, text]
        digest = hashlib.sha256(json.dumps(asked).encode())
        digest.update(png)
        return Path(self.options.cache) / f"{digest.hexdigest()}.json"


def _read_cached(path: Path) -> str:
    try:
        answer = json.loads(path.read_text(encoding="utf-8"))["answer"]
    except (OSError, ValueError, KeyError, TypeError):
        answer = None
    if not isinstance(answer, str):
        raise ServiceError(f"{path}: is no cached answer; delete it to ask again")
    return answer


@dataclass(frozen=True)
class _Call:
    """One question's requests, until a reply, a final refusal or the end of the time."""

    dialect: Dialect
    options: ServiceOptions
    key: str

    def reply(self, url: str, headers: dict[str, str], body: dict[str, Any]) -> Mapping[str, Any]:
        """The reply's JSON object."""
        request = urllib.request.Request(
            url, json.dumps(body).encode(), {"Content-Type": "application/json", **headers}, method="POST"
        )
        deadline = time.monotonic() + self.options.time_limit
        pause = self.options.backoff
        for attempt in range(self.options.retries + 1):
            trouble, wait = "", 0.0
            try:
                return _object(self._body(request, deadline), self.dialect.name)
            except urllib.error.HTTPError as e:
                message = self._message(e)
                if e.code in (401, 403) or "API_KEY_INVALID" in message or "API key not valid" in message:
                    raise ServiceError(
                        f"{self.dialect.name}: the key in {self.dialect.key_variable} is refused ({e.code}: {message})"
                    ) from None
                if e.code not in TEMPORARY:
                    raise ServiceError(f"{self.dialect.name}: the request is refused ({e.code}: {message})") from None
                trouble, wait = f"{e.code}: {message}", _retry_after(e.headers.get("Retry-After"))
            except TimeoutError:
                trouble = f"no reply within {self.options.timeout:g} s"
            except (urllib.error.URLError, OSError, http.client.HTTPException) as e:
                reason = getattr(e, "reason", e)
                late = isinstance(reason, TimeoutError)
                trouble = f"no reply within {self.options.timeout:g} s" if late else self._clean(str(reason))
            wait = max(wait, pause)
            if attempt == self.options.retries:
                raise ServiceError(f"{self.dialect.name}: gave up after {attempt + 1} requests ({trouble})")
            if time.monotonic() + wait > deadline:
                raise ServiceError(
                    f"{self.dialect.name}: gave up after {attempt + 1} requests, the next would come after the time "
                    f"limit of {self.options.time_limit:g} s ({trouble})"
                )
            time.sleep(wait)
            pause *= 2
        raise AssertionError("the last attempt returns or raises")

    def _body(self, request: urllib.request.Request, deadline: float) -> bytes:
        """The reply's bytes; slow as a whole is late too, not only between two bytes."""
        until = min(deadline, time.monotonic() + self.options.timeout)
        parts, size = [], 0
        with _OPENER.open(request, timeout=max(0.001, until - time.monotonic())) as response:
            while part := response.read1(65536):
                parts.append(part)
                size += len(part)
                if size > LONGEST_REPLY:
                    raise ServiceError(f"{self.dialect.name}: the reply is longer than {LONGEST_REPLY} bytes")
                if time.monotonic() > until:
                    raise TimeoutError
        return b"".join(parts)

    def _message(self, error: urllib.error.HTTPError) -> str:
        """What the service says of an error, shortened, without the key."""
        try:
            text = error.read(4096).decode("utf-8", "replace")
        except (OSError, http.client.HTTPException):
            text = ""
        try:
            said = json.loads(text)["error"]
            text = str(said["message"]) if isinstance(said, dict) else str(said)
        except (ValueError, KeyError, TypeError):
            pass
        return self._clean(text) or error.reason or "no message"

    def _clean(self, text: str) -> str:
        text = " ".join(text.split())
        text = text.replace(self.key, "<key>") if self.key else text
        return "".join(c if c.isprintable() else "?" for c in text)[:200]


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Refuses redirects: they would carry the key somewhere else."""

    def redirect_request(self, *unused: Any) -> None:
        return None


_OPENER = urllib.request.build_opener(_NoRedirect)


def _object(body: bytes, name: str) -> Mapping[str, Any]:
    try:
        reply = json.loads(body)
    except (ValueError, RecursionError):
        raise ServiceError(f"{name}: the reply is not JSON, found {body[:60]!r}") from None
    if not isinstance(reply, dict):
        raise ServiceError(f"{name}: the reply is not a JSON object, found {type(reply).__name__}")
    return reply


def _retry_after(value: str | None) -> float:
    """Seconds of a Retry-After header, which is a number or a date; 0 where there is none or it makes no sense."""
    if value is None:
        return 0.0
    try:
        seconds = float(value)
    except ValueError:
        try:
            when = parsedate_to_datetime(value)
        except ValueError:
            return 0.0
        when = when.replace(tzinfo=UTC) if when.tzinfo is None else when
        seconds = (when - datetime.now(UTC)).total_seconds()
    return max(0.0, seconds) if math.isfinite(seconds) else 0.0
