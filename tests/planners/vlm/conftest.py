"""A scene with food, its frame, and a server on loopback that speaks the services' protocol."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
import torch

from sagemp_cli.config.folders import load_scene
from sagemp_cli.planners.vlm import VLM
from sagemp_cli.planners.vlm import request as request_module
from sagemp_cli.planners.vlm import service as service_module
from sagemp_cli.planners.vlm.service import ENDPOINTS, ServiceOptions
from sagemp_cli.scenes import Frame, Scene, scene_from_mapping

START = torch.tensor([-1.5, -0.2, 0.0], dtype=torch.float64)
KEY = "a-secret-key"


@pytest.fixture(scope="session")
def table() -> Scene:
    return scene_from_mapping(load_scene("table"), state_dim=3, position_dim=2)


@pytest.fixture(scope="session")
def frame(table) -> Frame:
    return Frame.of(table.workspace)


def completion(content: Any) -> dict[str, Any]:
    """What a service replies when its model says ``content``."""
    message = {"role": "assistant", "content": content, "refusal": None}
    return {"object": "chat.completion", "choices": [{"index": 0, "message": message, "finish_reason": "stop"}]}


@dataclass
class Reply:
    """What the server does with one request: status, body (a dict is sent as JSON), headers, seconds before it."""

    status: int = 200
    body: Any = ""
    headers: dict[str, str] = field(default_factory=dict)
    after: float = 0.0


@dataclass
class Loopback:
    """A running server: requests get the next of ``replies``, the last again and again."""

    url: str
    replies: list[Reply] = field(default_factory=list)
    requests: list[dict[str, Any]] = field(default_factory=list)
    closing: threading.Event = field(default_factory=threading.Event)

    def next_reply(self) -> Reply:
        return self.replies.pop(0) if len(self.replies) > 1 else self.replies[0]


@pytest.fixture
def server(monkeypatch) -> Iterator[Loopback]:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY", "GEMINI_API_KEY", "OPENAI_API_KEY"):
        monkeypatch.delenv(name, raising=False)

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            loopback.requests.append(
                {"path": self.path, "headers": {k.lower(): v for k, v in self.headers.items()}, "body": body}
            )
            reply = loopback.next_reply()
            loopback.closing.wait(reply.after)
            sent = json.dumps(reply.body).encode() if isinstance(reply.body, dict) else str(reply.body).encode()
            try:
                self.send_response(reply.status)
                for name, value in reply.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(sent)))
                self.end_headers()
                self.wfile.write(sent)
            except OSError:
                pass  # the client gave up waiting

        def log_message(self, *unused: Any) -> None:
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    http.daemon_threads = True
    loopback = Loopback(f"http://127.0.0.1:{http.server_port}")
    thread = threading.Thread(target=http.serve_forever, args=(0.02,))
    thread.start()
    yield loopback
    loopback.closing.set()
    http.shutdown()
    thread.join()
    http.server_close()


@pytest.fixture
def reply() -> type[Reply]:
    """``reply(status, body, headers, after)``: what the server is to do."""
    return Reply


@pytest.fixture
def provider() -> str:
    """Which service is asked; a test may parametrize it with the other."""
    return "openai"


@pytest.fixture
def in_this_process(monkeypatch) -> None:
    """Requests are made here, not in a process each (half a second): for what has nothing to do with time."""

    def here(request: dict[str, Any], seconds: float) -> dict[str, Any]:
        return json.loads(json.dumps(request_module.ask(json.loads(json.dumps(request)))))

    monkeypatch.setattr(service_module, "ask_in_process", here)


@pytest.fixture
def ask(server, provider, table, monkeypatch) -> Callable[..., torch.Tensor]:
    """``ask(reply, ..., count=1, key=KEY, seed=0, prompt=..., **service)``: references from the server's replies.

    A reply is a :class:`Reply`, or a text that the model answers.
    """

    def call(
        *replies: Reply | str,
        count: int = 1,
        key: str | None = KEY,
        seed: int = 0,
        prompt: str = "over_burger",
        attempts: int = 1,
        **service: Any,
    ) -> torch.Tensor:
        variable = ENDPOINTS[provider].key_variable
        if key is None:
            monkeypatch.delenv(variable, raising=False)
        else:
            monkeypatch.setenv(variable, key)
        server.replies[:] = [r if isinstance(r, Reply) else Reply(body=completion(r)) for r in replies]
        options = {"base_url": server.url, "image_height": 32, "backoff": 0.01, "timeout": 20.0, "retries": 2} | service
        given = {"provider": provider, "prompt": prompt, "attempts": attempts, "service": ServiceOptions(**options)}
        planner = VLM(state_dim=3, horizon=20, dt=0.5, **given)
        generator = torch.Generator().manual_seed(seed)
        return planner.sample(START, table.goal, scene=table, count=count, generator=generator)

    return call


@pytest.fixture
def clock() -> Callable[[], float]:
    began = time.monotonic()
    return lambda: time.monotonic() - began
