import numpy as np
import pytest

from sagemp_cli.errors import UsageError
from sagemp_cli.library import closest_reference


def plans(count, seed):
    return np.random.default_rng(seed).normal(size=(count, 6, 3))


def by_hand(sampled, library):
    """Equation 10 written as loops."""
    index, error = [], []
    for tau in sampled:
        errors = [sum(((a[k] - tau[k]) ** 2).sum() for k in range(1, len(tau))) for a in library]
        index.append(int(np.argmin(errors)))
        error.append(min(errors))
    return index, error


@pytest.mark.parametrize("tree_from", [1000, 10])
def test_the_closest_reference_is_that_of_brute_force(tree_from):
    sampled, library = plans(20, 0), plans(40, 1)
    index, error = closest_reference(sampled, library, tree_from=tree_from)
    wanted_index, wanted_error = by_hand(sampled, library)
    assert index.tolist() == wanted_index
    np.testing.assert_allclose(error, wanted_error, rtol=1e-12)


def test_a_library_entry_is_closest_to_itself_with_error_zero():
    library = plans(30, 2)
    index, error = closest_reference(library, library)
    assert index.tolist() == list(range(30))
    assert (error == 0).all()


def test_the_start_does_not_count():
    library = plans(2, 3)
    sampled = library[:1].copy()
    sampled[:, 0] += 100.0
    assert closest_reference(sampled, library)[1].tolist() == [0.0]


def test_only_eligible_entries_are_chosen():
    sampled, library = plans(5, 4), plans(12, 5)
    eligible = np.zeros((5, 12), dtype=bool)
    eligible[:, [3, 7]] = True
    index, _ = closest_reference(sampled, library, eligible=eligible, tree_from=2)
    wanted, _ = by_hand(sampled, library[[3, 7]])
    assert index.tolist() == [[3, 7][i] for i in wanted]


def test_an_empty_library_a_foreign_shape_and_nothing_eligible_are_refused():
    with pytest.raises(UsageError, match="the library holds no certified reference"):
        closest_reference(plans(1, 0), plans(0, 0))
    with pytest.raises(UsageError, match=r"proposals of shape \(5, 3\) do not fit a library of shape \(6, 3\)"):
        closest_reference(plans(1, 0)[:, :5], plans(2, 0))
    with pytest.raises(UsageError, match="proposal 1 has no eligible reference"):
        closest_reference(plans(2, 0), plans(2, 1), eligible=np.array([[True, False], [False, False]]))
