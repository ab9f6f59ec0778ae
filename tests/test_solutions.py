"""Simulated solutions lie within what certificates in continuous time say; one that says too little is caught."""

import dataclasses

import numpy as np
import pytest
import torch
from solutions import MARGIN, compared, continuous

from sagemp_cli.sets import Box
from sagemp_cli.storage import Header, write_artifact

from .checker.continuous import flow_case
from .checker.required import config, in_two_ways, written


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("solutions")


@pytest.fixture(scope="module")
def record(folder):
    return written(in_two_ways(), folder / "right.h5")


def found(path):
    with torch.no_grad():
        return compared(path, 0, 60, torch.Generator().manual_seed(0))


def test_no_solution_leaves_a_right_certificate_whose_cells_are_divided_in_two_ways(folder, record):
    assert continuous(folder / "right.h5")
    right = found(folder / "right.h5")
    assert (right.rollouts, right.outside) == (60, 0) and right.worst <= MARGIN


def test_solutions_under_a_control_that_lags_are_compared_too(folder):
    lag = Box(*torch.tensor([[0.0, 0.005], [0.12, 0.02]], dtype=torch.float64))
    flow_case(folder / "lag.h5", horizon=3, lag=lag)
    late = found(folder / "lag.h5")
    assert (late.rollouts, late.outside) == (60, 0)


@pytest.mark.parametrize("name", ["tube_upper", "clearance", "upper"])
def test_one_that_says_too_little_is_caught(folder, record, name):
    tubes, flow = record.tubes, record.tubes.flow
    if name == "upper":
        side = flow.upper * np.where(flow.upper > 0, 0.5, 2.0)
        made = dataclasses.replace(tubes, flow=dataclasses.replace(flow, upper=side))
    else:
        side = getattr(tubes, name)
        made = dataclasses.replace(tubes, **{name: side + 0.1 if name == "clearance" else side - 0.02})
    path = folder / f"{name}.h5"
    header = Header(stage="prove", experiment="body", config=config(4))
    write_artifact(path, dataclasses.replace(record, tubes=made), header)
    assert found(path).outside > 0
