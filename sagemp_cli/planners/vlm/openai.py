"""How OpenAI's chat completions are spoken to, and the many servers that speak the same, without a client library."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any


class OpenAI:
    """See :class:`~sagemp_cli.planners.vlm.service.Dialect`; with a ``base_url`` of one's own no key is needed."""

    name = "openai"
    key_variable = "OPENAI_API_KEY"
    base_url = "https://api.openai.com/v1"
    model = "gpt-4o"

    def request(
        self, base_url: str, model: str, key: str, *, text: str, png: bytes, temperature: float, seed: int
    ) -> tuple[str, dict[str, str], dict[str, Any]]:
        """Address, headers and body of the request for one answer."""
        image = {"url": f"data:image/png;base64,{base64.b64encode(png).decode()}"}
        content = [{"type": "text", "text": text}, {"type": "image_url", "image_url": image}]
        body = {
            "model": model,
            "messages": [{"role": "user", "content": content}],
            "temperature": temperature,
            "seed": seed,
        }
        return f"{base_url}/chat/completions", {"Authorization": f"Bearer {key}"} if key else {}, body

    def answer(self, reply: Mapping[str, Any]) -> str:
        """The text of a reply; a refusal is given as such."""
        message = reply["choices"][0]["message"]
        refusal, content = message.get("refusal"), message.get("content")
        if refusal:
            return f"refused by the model: cannot answer ({refusal})"
        if isinstance(content, list):  # some servers give the text in parts
            return "".join(part.get("text", "") for part in content)
        return content or ""
