"""The prompts against the paper's own LaTeX, word for word; and the numbers that are put in."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sagemp_cli.errors import ConfigError
from sagemp_cli.planners.vlm.prompts import axes_of, fill, template

APPENDIX = (Path(__file__).parent / "appendix.tex").read_text(encoding="utf-8")
"""The paper's appendix from its first prompt on, as typeset there."""

PROMPTS = ("avoid_food", "over_burger", "blue_circles")


def boxes_of(tex: str) -> list[str]:
    """The text of each box of the appendix, without LaTeX."""
    found = []
    for box in re.findall(r"\\begin\{tcolorbox\}\[[^\]]*\](.*?)\\end\{tcolorbox\}", tex, re.DOTALL):
        text = re.sub(r"\\(?:begin|end)\{itemize\}(?:\[[^\]]*\])?", " ", box)
        text = re.sub(r"\\item|\\noindent", " ", text)
        text = re.sub(r"\\(?:texttt|textrm)\{([^}]*)\}", r"\1", text)
        # "\textrm{start\_np}[0]:.2f" and "$x$-axis"
        found.append(text.replace(r"\_", "_").replace("$", ""))
    return found


def words_of(text: str) -> list[str]:
    """Words with their punctuation; bullets and asterisks are typesetting."""
    return [word for word in text.replace("*", " ").split() if word]


@pytest.mark.parametrize(("prompt", "index"), [(name, i) for i, name in enumerate(PROMPTS)])
def test_a_prompt_is_the_papers_word_for_word(prompt, index):
    boxes = boxes_of(APPENDIX)
    assert len(boxes) == 3
    assert words_of(template(prompt)) == words_of(boxes[index])


def test_the_second_prompt_keeps_the_papers_asterisks():
    box = boxes_of(APPENDIX)[1]
    assert template("over_burger").split() == box.split()


def test_the_comparison_would_notice_one_changed_word():
    changed = template("avoid_food").replace("efficient and direct", "direct and efficient")
    assert words_of(changed) != words_of(boxes_of(APPENDIX)[0])


@pytest.mark.parametrize("prompt", PROMPTS)
def test_start_and_goal_are_put_in_with_two_decimals_and_nothing_else_changes(prompt):
    raw, text = template(prompt), fill(template(prompt), start=[-0.754, 0.1], goal=[0.5, -0.25])
    assert "[-0.75, 0.10]" in text and "[0.50, -0.25]" in text
    assert "{" not in text.replace('{"waypoints": [[-0.5, -0.2], [0.1, -0.5]]}', "")
    assert "[current start]" not in text and "_np" not in text
    kept = [line for line in raw.splitlines() if "Point" not in line and "{{" not in line]
    assert all(line in text.splitlines() for line in kept)


def test_braces_of_a_prompt_are_never_evaluated():
    assert fill("{start_np.__class__} {0} [goal]", start=[0, 0], goal=[1, 1]) == (
        "{start_np.__class__} {0} [1.00, 1.00]"
    )


def test_the_axes_are_those_that_the_prompt_speaks_of():
    assert axes_of("blue_circles") == ((-1.0, 1.0), (-1.0, 0.0))
    assert axes_of("avoid_food") == ((-1.0, 1.0), (-1.0, 1.0))
    assert "y from -1.0 to 0.0" in template("blue_circles")


def test_a_prompt_of_ones_own_is_read_from_its_path(tmp_path):
    path = tmp_path / "mine.txt"
    path.write_text("Go from [current start] to [goal].")
    assert fill(template(str(path)), start=[0, 0], goal=[1, 0.5]) == "Go from [0.00, 0.00] to [1.00, 0.50]."


def test_an_unknown_prompt_is_refused_with_the_nearest_known_one():
    with pytest.raises(ConfigError, match=re.escape("'avoid_fod': no such prompt (did you mean 'avoid_food'?)")):
        template("avoid_fod")
