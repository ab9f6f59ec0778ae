"""Runs at the same time: pieces of work that somebody uses are nobody else's to remove."""

from __future__ import annotations

import shutil

from sagemp_cli.pipeline import claim as claims
from sagemp_cli.pipeline.claim import Claim, remove_unused


def test_a_folder_in_use_is_removed_by_the_last_who_uses_it(tmp_path):
    folder = tmp_path / "stage" / "work"
    first, second = Claim(folder), Claim(folder)
    (folder / "piece").write_bytes(b"x")
    first.remove()
    assert (folder / "piece").exists()
    second.remove()
    assert list(tmp_path.iterdir()) == []
    second.remove()  # a second time there is nothing to do


def test_work_of_another_config_is_removed_only_if_no_run_uses_it(tmp_path):
    used, left = Claim(tmp_path / "used"), Claim(tmp_path / "left")
    left.release()
    (tmp_path / "file").write_bytes(b"x")
    (tmp_path / "old").mkdir()  # of an earlier version, which did not say who uses it
    for other in list(tmp_path.iterdir()):
        remove_unused(other)
    assert list(tmp_path.iterdir()) == [used.folder]
    used.release()
    remove_unused(used.folder)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_vanishes_between_its_making_and_its_claim_is_made_again(tmp_path, monkeypatch):
    folder, taken = tmp_path / "stage" / "work", []

    def lock(handle, *, shared):
        if not taken:
            shutil.rmtree(folder)
        taken.append(handle)
        return True

    monkeypatch.setattr(claims, "_lock", lock)
    claim = Claim(folder)
    assert len(taken) == 2
    assert (folder / ".in-use").exists()
    claim.release()
