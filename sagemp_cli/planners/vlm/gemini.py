"""How Gemini's REST interface is spoken to (``models/<model>:generateContent``), without its client library."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any
from urllib.parse import quote


class Gemini:
    """See :class:`~sagemp_cli.planners.vlm.service.Dialect`; the default model is the paper's."""

    name = "gemini"
    key_variable = "GEMINI_API_KEY"
    base_url = "https://generativelanguage.googleapis.com"
    model = "gemini-2.5-pro"

    def request(
        self, base_url: str, model: str, key: str, *, text: str, png: bytes, temperature: float, seed: int
    ) -> tuple[str, dict[str, str], dict[str, Any]]:
        """Address, headers and body of the request for one answer."""
        image = {"inline_data": {"mime_type": "image/png", "data": base64.b64encode(png).decode()}}
        body = {
            "contents": [{"role": "user", "parts": [{"text": text}, image]}],
            "generationConfig": {"temperature": temperature, "seed": seed, "candidateCount": 1},
        }
        headers = {"x-goog-api-key": key} if key else {}
        return f"{base_url}/v1beta/models/{quote(model, safe='')}:generateContent", headers, body

    def answer(self, reply: Mapping[str, Any]) -> str:
        """The text of a reply; a blocked prompt or answer is said as a refusal."""
        candidates = reply.get("candidates") or []
        if not candidates:
            reason = reply["promptFeedback"].get("blockReason", "no reason given")
            return f"refused by the service: cannot answer ({reason})"
        parts = candidates[0].get("content", {}).get("parts", [])
        text = "".join(part.get("text", "") for part in parts if not part.get("thought"))
        ended = candidates[0].get("finishReason", "STOP")
        return text if text or ended == "STOP" else f"refused by the service: cannot answer ({ended})"
