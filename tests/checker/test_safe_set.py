"""What the checker makes of a scene: landmarks and drawings are no obstacles, anything unknown is refused."""

from __future__ import annotations

import pytest

from sagemp_cli.checker.balls import Unproved
from sagemp_cli.checker.scene import SafeSet
from sagemp_cli.config.folders import load_scene


def test_landmarks_and_drawings_change_nothing_about_the_safe_set():
    scene = load_scene("table")
    bare = {key: value for key, value in scene.items() if key != "landmarks"}
    bare["obstacles"] = [{k: v for k, v in item.items() if k != "object"} for item in scene["obstacles"]]
    assert len(scene["landmarks"]) == 1 and SafeSet.of(scene) == SafeSet.of(bare)
    assert SafeSet.of(scene).names == ("workspace", "apple", "cup", "pizza", "banana", "donut", "orange")


def test_what_the_checker_does_not_know_of_a_scene_is_refused():
    with pytest.raises(Unproved, match="the scene says 'rivers', which is not understood"):
        SafeSet.of(load_scene("table") | {"rivers": []})
