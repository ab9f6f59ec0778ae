import dataclasses

import numpy as np
import pytest

from sagemp_cli.errors import ArtifactError
from sagemp_cli.pipeline.tubes import tubes_record, verification_of
from sagemp_cli.storage import Library, read_artifact

from .conftest import assert_same


@pytest.fixture
def tubes(toy_folder):
    return read_artifact(toy_folder / "library.h5", Library).record.tubes


def test_tubes_come_back_from_the_record_as_they_went(tubes):
    again = tubes_record(verification_of(tubes, "library.h5"))
    assert tubes.relaxations is not None and again.relaxations is None  # they are for who proves it again
    assert_same(again, dataclasses.replace(tubes, relaxations=None))
    np.testing.assert_array_equal(again.seconds, tubes.seconds)


def test_a_reference_without_cells_and_cells_out_of_order_are_refused(tubes):
    owner = tubes.cell_reference.copy()
    owner[:] = 1
    with pytest.raises(ArtifactError, match="library.h5: /data/tubes/cell_reference must list the cells of each"):
        verification_of(dataclasses.replace(tubes, cell_reference=owner), "library.h5")
    with pytest.raises(ArtifactError, match="of each of 2 references in turn"):
        verification_of(dataclasses.replace(tubes, cell_reference=tubes.cell_reference[::-1].copy()), "library.h5")


def test_an_unknown_verdict_is_refused(tubes):
    odd = dataclasses.replace(tubes, verdict=("FINE", "SAFE"))
    with pytest.raises(ArtifactError, match="library.h5: /data/tubes/verdict holds 'FINE'; known: SAFE, MAY_COLLIDE"):
        verification_of(odd, "library.h5")
