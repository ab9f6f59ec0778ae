"""A vision-language model behind a network: a key, questions that are repeated where that can help, and a cache."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import json
import math
import os
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import torch

from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.planners.vlm.question import Question
from sagemp_cli.planners.vlm.recording import Recording, read_recording, write_recording
from sagemp_cli.planners.vlm.request import Outcome, ask_in_process

TEMPORARY = (408, 429, 500, 502, 503, 504)
"""HTTP statuses after which the same request may succeed."""
SHORTEST_KEY = 8
"""Characters; what is shorter could not be taken out of an answer without taking it apart."""


class ServiceError(UsageError):
    """A service that cannot be used: no key, a refused key, out of reach, too slow, or a reply that is none."""


@dataclass(frozen=True)
class ServiceOptions:
    """How a service is called.

    Attributes:
        model: its name there; None for the provider's default.
        base_url: where the service is; None for the provider's public one.
        temperature: of the sampling.
        image_height: pixels of the picture that is sent.
        timeout: seconds that one request may take, from its process's start to the last byte.
        time_limit: seconds that a plan may take with all answers that are asked for it, repetitions and pauses; several
            plans that are asked for together share as many times that.
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
        if self.base_url is not None:
            _complain_about(self.base_url)


@dataclass(frozen=True)
class Endpoint:
    """A service that speaks OpenAI's chat completions.

    Attributes:
        name: of the provider.
        key_variable: environment variable that holds the key.
        base_url: of the public service.
        model: the default one.
        takes_seed: whether it knows the parameter ``seed``; Gemini refuses requests with it.
    """

    name: str
    key_variable: str
    base_url: str
    model: str
    takes_seed: bool


ENDPOINTS = {
    e.name: e
    for e in (
        Endpoint(
            "gemini",
            "GEMINI_API_KEY",
            "https://generativelanguage.googleapis.com/v1beta/openai",
            model="gemini-2.5-pro",  # the paper's
            takes_seed=False,
        ),
        Endpoint("openai", "OPENAI_API_KEY", "https://api.openai.com/v1", model="gpt-4o", takes_seed=True),
    )
}
"""The services by the names of their providers."""


@dataclass(frozen=True)
class Service:
    """A provider that asks a service.

    The key comes from the environment and nowhere else. It is in no config, artifact, cache or message: what the
    service says is freed of it in :mod:`~sagemp_cli.planners.vlm.request`, before it gets here.

    Attributes:
        endpoint: which one.
        options: address, model and limits.
        deadline: when all answers must be there, on the clock of ``time.monotonic``; None: see :meth:`within`.
    """

    endpoint: Endpoint
    options: ServiceOptions
    deadline: float | None = None

    @property
    def model(self) -> str:
        """The model that is asked."""
        return self.options.model or self.endpoint.model

    @property
    def label(self) -> str:
        """What answers, for figures."""
        return f"{self.endpoint.name}: {self.model}"

    def within(self, plans: int) -> Service:
        """The same with the time that so many plans may take from now on, however often they are asked for."""
        return replace(self, deadline=time.monotonic() + plans * self.options.time_limit)

    def answers(self, questions: Sequence[Question], *, generator: torch.Generator) -> list[str]:
        """One answer per question; equal questions get a seed each, so answers may differ.

        The seeds come from ``generator``, so a run that is repeated asks the same and finds its answers in the cache.

        Raises:
            ServiceError: there is no answer to be had, or not in time.
        """
        if self.deadline is None:
            return self.within(len(questions)).answers(questions, generator=generator)
        seeds = torch.randint(2**31 - 1, (len(questions),), generator=generator).tolist()
        return [self._answer(question, seed) for question, seed in zip(questions, seeds, strict=True)]

    def _answer(self, question: Question, seed: int) -> str:
        png = question.png(self.options.image_height)
        path = self._cached(question.text, png, seed)
        if path is not None and path.exists():
            return read_recording(path).answers[0]
        if importlib.util.find_spec("openai") is None:
            raise ServiceError(
                f"planner.provider '{self.endpoint.name}' needs the package openai; install sagemp with its extra 'vlm'"
            )
        request = {
            "base_url": (self.options.base_url or self.endpoint.base_url).rstrip("/"),
            "key": self._key(),
            "model": self.model,
            "text": question.text,
            "png": base64.b64encode(png).decode(),
            "temperature": self.options.temperature,
            "seed": seed if self.endpoint.takes_seed else None,
        }
        answer = self._asked(request)
        if path is not None:
            today = datetime.now(UTC).date().isoformat()
            write_recording(path, Recording((answer,), self.model, today, question.prompt_hash))
        return answer

    def _cached(self, text: str, png: bytes, seed: int) -> Path | None:
        """Where the answer to a question is kept: by a hash of all that could change it."""
        if self.options.cache is None:
            return None
        asked = [self.endpoint.name, self.options.base_url, self.model, self.options.temperature, seed, text]
        digest = hashlib.sha256(json.dumps(asked).encode())
        digest.update(png)
        return Path(self.options.cache) / f"{digest.hexdigest()}.json"

    def _key(self) -> str:
        """The key, or "" where a server of one's own is asked without one."""
        name, key = self.endpoint.key_variable, os.environ.get(self.endpoint.key_variable, "")
        if not key and self.options.base_url is None:
            raise ServiceError(
                f"planner.provider '{self.endpoint.name}' needs a key in the environment variable "
                f"{name}; without one use planner.provider=local (a stand-in) or replay"
            )
        if key and re.fullmatch(r"[!-~]+", key) is None:
            raise ServiceError(f"the key in {name} must be visible ASCII characters without spaces or line breaks")
        if key and len(key) < SHORTEST_KEY:
            raise ServiceError(
                f"the key in {name} has {len(key)} characters, at least {SHORTEST_KEY} are needed; "
                "unset it for a server that asks for none"
            )
        return key

    def _asked(self, request: dict[str, Any]) -> str:
        """The answer to a request, repeated until there is one, a final refusal, or the end of the time."""
        assert self.deadline is not None
        name, pause = self.endpoint.name, self.options.backoff
        limit = f"the time limit of {self.options.time_limit:g} s a plan"
        for attempt in range(self.options.retries + 1):
            seconds = min(self.options.timeout, self.deadline - time.monotonic())
            if seconds <= 0:
                raise ServiceError(f"{name}: gave up, {limit} ran out")
            outcome = ask_in_process(request, seconds)
            if outcome is None:
                outcome = {"lost": f"no reply within {seconds:.3g} s"}
            if "answer" in outcome:
                return outcome["answer"]
            trouble = self._trouble(outcome)
            wait = max(_retry_after(outcome.get("retry_after")), pause)
            if attempt == self.options.retries:
                raise ServiceError(f"{name}: gave up after {attempt + 1} requests ({trouble})")
            if time.monotonic() + wait >= self.deadline:
                raise ServiceError(
                    f"{name}: gave up after {attempt + 1} requests, the next would come after {limit} ({trouble})"
                )
            time.sleep(wait)
            pause *= 2
        raise AssertionError("the last attempt returns or raises")

    def _trouble(self, outcome: Outcome) -> str:
        """What went wrong, if another try may help.

        Raises:
            ServiceError: none can.
        """
        name = self.endpoint.name
        if "wrong" in outcome:
            raise ServiceError(f"{name}: {_line(outcome['wrong'])}")
        if "lost" in outcome:
            return _line(outcome["lost"])
        said = f"{outcome['status']}: {_line(outcome['message']) or 'no message'}"
        if outcome["status"] in (401, 403) or "API key not valid" in said:
            raise ServiceError(f"{name}: the key in {self.endpoint.key_variable} is refused ({said})")
        if outcome["status"] not in TEMPORARY:
            raise ServiceError(f"{name}: the request is refused ({said})")
        return said


def _complain_about(base_url: str) -> None:
    try:
        url = urlsplit(base_url)
        bad = url.scheme not in ("http", "https") or not url.hostname or url.port == 0
    except ValueError:  # a port that is none, brackets that do not close
        raise ConfigError("planner.service.base_url is no address") from None
    if bad:
        raise ConfigError(f"planner.service.base_url must begin with http:// or https://, found '{base_url}'")
    if url.username is not None or url.query or url.fragment:  # not shown: it may hold a password
        raise ConfigError(
            "planner.service.base_url must hold no user, password or parameters; a key comes from the environment"
        )


def _line(text: str) -> str:
    """A stranger's text as part of one line that a terminal may show."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))[:200]


def _retry_after(value: str | None) -> float:
    """Seconds of a Retry-After header, which is a number or a date; 0 where there is none or it makes no sense."""
    if value is None:
        return 0.0
    try:
        seconds = float(value)
    except ValueError:
        try:
            when = parsedate_to_datetime(value)
            when = when.replace(tzinfo=UTC) if when.tzinfo is None else when
            seconds = (when - datetime.now(UTC)).total_seconds()
        except (ValueError, OverflowError, TypeError, IndexError):  # a year of many digits, an offset of days
            return 0.0
    return 0.0 if math.isnan(seconds) else max(0.0, seconds)
