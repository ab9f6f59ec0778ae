"""Waypoints out of a model's answer, which is untrusted text: parsed as JSON, validated, never run."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FiniteFloat, ValidationError
from pydantic_core import from_json

from sagemp_cli.errors import UsageError
from sagemp_cli.scenes.frame import Frame

MOST_WAYPOINTS = 100
LONGEST_ANSWER = 100_000
"""Characters; nothing longer is looked at."""

DEEPEST = 100
"""Brackets open at a time, at most: seen before a parser gets them, whatever its own limit is."""
MOST_LOOKS = 20
"""How often the longest answer is looked through at most, in search of where its JSON begins."""
_OPENING = re.compile(r"[\[{]")
_TOKENS = re.compile(r'"(?:[^"\\]+|\\.)*+"?|[\[{\]}]', re.DOTALL)
"""Strings, the last of which may be cut off, and brackets."""
_ON_THE_EDGE = 1e-6
_REFUSALS = re.compile(r"\b(can(?:no|['’])t|unable|won['’]t|will not|not able|sorry|refuse|apolog)", re.IGNORECASE)


class AnswerError(UsageError):
    """An answer that gives no usable waypoints; the message is one line that says what is wrong with it."""


class _Waypoints(BaseModel):
    """``{"waypoints": [[x, y], ...]}``, numbers only: a text that looks like a number is not one."""

    model_config = ConfigDict(strict=True)
    waypoints: list[tuple[FiniteFloat, FiniteFloat]]


def waypoints_of(answer: str, frame: Frame, *, most: int = MOST_WAYPOINTS) -> NDArray[np.float64]:
    """The waypoints ``(J, 2)`` of an answer, in the frame's image coordinates.

    Prose around the JSON and code fences are put up with; the first object or list of the text that holds
    waypoints counts. A bare list of pairs, and points as ``{"x": ..., "y": ...}``, are understood as well, since two
    of the paper's prompts do not say how the object looks.

    Raises:
        AnswerError: the answer is empty, a refusal, without JSON, without waypoints, or has too few or too many of
            them, wrong types, numbers that are not finite, or places outside the picture or the workspace.
    """
    text = answer.strip()
    if not text:
        raise AnswerError("the answer is empty")
    if len(text) > LONGEST_ANSWER:
        raise AnswerError(f"the answer has {len(text)} characters, {LONGEST_ANSWER} are looked at at most")
    points = [_pair(point) for point in _listed(text)]
    try:
        valid = _Waypoints.model_validate({"waypoints": points})
    except ValidationError as e:
        first = e.errors()[0]
        j, *entry = first["loc"][1:]
        assert isinstance(j, int)
        if len(entry) != 1 or first["type"] == "missing":
            point = points[j]
            raise AnswerError(f"waypoints[{j}] must be two numbers [x, y], found {_short(point)}") from None
        where = f"waypoints[{j}][{entry[0]}]"
        raise AnswerError(f"{where} must be a finite number, found {_short(first['input'])}") from None
    found = np.array(valid.waypoints, dtype=np.float64).reshape(-1, 2)
    if len(found) == 0:
        raise AnswerError("the answer lists no waypoints, at least 1 is needed")
    if len(found) > most:
        raise AnswerError(f"the answer lists {len(found)} waypoints, at most {most} are allowed")
    low, high = np.array([frame.x[0], frame.y[0]]), np.array([frame.x[1], frame.y[1]])
    _refuse_outside(found, low, high, "image")
    low, high = frame.to_image(np.array(frame.workspace))
    _refuse_outside(found, low, high, "workspace")
    return found


def _refuse_outside(points: NDArray[np.float64], low: NDArray, high: NDArray, what: str) -> None:
    outside = ((points < low - _ON_THE_EDGE) | (points > high + _ON_THE_EDGE)).any(-1)
    if outside.any():
        j = int(outside.argmax())
        ranges = " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True))
        raise AnswerError(f"waypoints[{j}] lies outside the {what} {ranges}, found {_short(points[j].tolist())}")


def _listed(text: str) -> list[Any]:
    """The first list of the text's JSON that can be waypoints."""
    seen, position, looked_at = [], 0, 0
    while (opening := _OPENING.search(text, position)) is not None:
        end = _end_of(text, opening.start())
        looked_at += (end or len(text)) - opening.start()
        if looked_at > MOST_LOOKS * LONGEST_ANSWER:
            raise AnswerError("the answer is a tangle of brackets")
        position = opening.end()
        if end is None:
            continue
        try:
            value = from_json(text[opening.start() : end])
        except ValueError:  # no JSON here, or a number of thousands of digits
            continue
        position = end
        seen.append(value)
        listed = _waypoint_list(value)
        if listed is not None:
            return listed
    if seen and any(isinstance(value, dict) for value in seen):
        named = next(value for value in seen if isinstance(value, dict))
        raise AnswerError(f"the answer's JSON has no list of waypoints, found keys {_short(list(named))}")
    if _REFUSALS.search(text):
        raise AnswerError(f"the model refuses: {_short(text)}")
    if '"waypoints"' in text:
        raise AnswerError(f"the answer's JSON is broken or cut off, found {_short(text)}")
    raise AnswerError(f"the answer holds no JSON object, found {_short(text)}")


def _end_of(text: str, start: int) -> int | None:
    """Where the bracket at ``start`` is closed; None if it never is. Brackets in strings do not count."""
    depth = 0
    for token in _TOKENS.finditer(text, start):
        if token.group() in ("[", "{"):
            depth += 1
        elif token.group() in ("]", "}"):
            depth -= 1
        if depth == 0:
            return token.end()
        if depth > DEEPEST:
            raise AnswerError("the answer's JSON is nested too deep")
    return None


def _waypoint_list(value: Any) -> list[Any] | None:
    """``value["waypoints"]``, the only list among an object's values, or a list of pairs."""
    if isinstance(value, dict):
        if "waypoints" in value:
            if not isinstance(value["waypoints"], list):
                raise AnswerError(f"waypoints must be a list of [x, y], found {_short(value['waypoints'])}")
            return value["waypoints"]
        lists = [entry for entry in value.values() if isinstance(entry, list)]
        return lists[0] if len(lists) == 1 else None
    paired = isinstance(value, list) and bool(value) and all(isinstance(point, list | dict) for point in value)
    return value if paired else None


def _pair(point: Any) -> Any:
    """A point as a tuple, if it is a list or names its x and y; what it holds is not looked at here."""
    if isinstance(point, dict) and set(point) == {"x", "y"}:
        return (point["x"], point["y"])
    return tuple(point) if isinstance(point, list) else point


def _short(value: Any) -> str:
    text = " ".join((value if isinstance(value, str) else repr(value)).split())
    text = "".join(c if c.isprintable() else "?" for c in text)
    return f"'{text}'" if len(text) <= 80 else f"'{text[:77]}...'"
