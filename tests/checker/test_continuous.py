"""Certificates in continuous time: proved from the file alone, and no solution of the ODE leaves what is proved."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from sagemp_cli.checker.balls import BITS, ctx
from sagemp_cli.checker.check import check, recheck
from sagemp_cli.checker.claim import claim_rows, equation_lines, said_rows
from sagemp_cli.checker.document import read_document
from sagemp_cli.checker.loop import Folded, Loop
from sagemp_cli.checker.step import Entry, Step
from sagemp_cli.checker.zonotope import Zonotope
from sagemp_cli.errors import ArtifactError
from sagemp_cli.pipeline.against import differences
from sagemp_cli.pipeline.tubes import counterexample_record, tubes_record
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.storage import Counterexample, Header, write_artifact
from sagemp_cli.verification.attack.refutation import FalsifierOptions, attack
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verification import verify_references

from .conftest import constants_of, make_case
from .continuous import FlowCase, flow_case


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> FlowCase:
    return flow_case(tmp_path_factory.mktemp("flow") / "certificate.h5")


@pytest.fixture(scope="module")
def path(case, tmp_path_factory):
    return case.write(tmp_path_factory.mktemp("flow") / "certificate.h5")


@pytest.mark.parametrize(("substeps", "order"), [(1, 1), (1, 3), (4, 2)])
def test_what_the_propagator_finds_is_proved_however_it_is_divided(substeps, order, tmp_path):
    made = flow_case(tmp_path / "certificate.h5", substeps=substeps, order=order)
    report = check(made.write(tmp_path / "certificate.h5"))
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    assert 0.05 < report.findings[0].clearance["disc"] < 0.2


def test_the_claim_is_about_all_times_and_says_the_ode(path):
    report = check(path)
    assert report.answer == "VERIFIED" and recheck(path) == ""
    rows = claim_rows(report.document)
    said = dict(rows)
    assert "all measurable w(t) in W and all times t in [0, K dt] = [0, 0.8] s" in said["for"]
    assert said["between"].startswith("continuous: the safe set is kept at all of these times")
    ode = [text for label, text in rows if label == "ODE"]
    assert ode[1:] == ["north' = sin(heading) + w_north", "heading' = 1.5 * u0 - 0.1 * heading + w_heading"]
    assert "in 2 parts, Taylor polynomials of degree 2" in said["how it is proved"]
    assert "held on [t_k, t_k + dt]" in said["control"]
    assert "between samples" not in dict(said_rows(report.document))  # the period is proved, not said
    assert equation_lines(report.document)[-1] == ode[-1]


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    """A unicycle on a reference, as verify proves it, and its report."""
    found = make_case(time="continuous")
    return found, check(found.write(tmp_path_factory.mktemp("robot") / "certificate.h5"))


def test_a_robot_under_a_tracker_is_proved_as_an_ode(robots):
    _, report = robots
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    rows = claim_rows(report.document)
    assert [text for label, text in rows if label == "ODE"][0] == "px' = v * cos(theta) + w_px"
    assert "reference 0" in dict(rows) and "8 periods of dt = 0.1 s" in dict(rows)["for"]


def test_products_of_what_is_nearly_the_same_are_proved(tmp_path):
    """Their bounds begin at 0 but for less than a rounding of what they end at."""
    report = check(make_case(time="continuous", order=3).write(tmp_path / "certificate.h5"))
    assert report.answer == "VERIFIED", (report.problems, report.findings)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda c: None, []),
        (lambda c: c["dynamics"].update(time="discrete"), ["between"]),
        (lambda c: c["dynamics"].update(dt=0.05), ["between samples"]),
        (lambda c: c["scene"]["obstacles"][0].update(radius=0.6), ["obstacle disc"]),
    ],
)
def test_what_is_proved_of_an_ode_is_held_against_a_config(change, what, robots):
    made, report = robots
    config = copy.deepcopy(made.config)
    change(config)
    found = differences(report, config)
    assert [d.what for d in found] == what
    assert all(d.covers == (d.what == "obstacle disc") for d in found)


def test_another_ode_is_found_at_points(robots, mutate, tmp_path):
    made, report = robots

    def turned(file):
        kinds = file[f"{RATE}/kinds"]
        sine, cosine = (kinds.asstr()[()].tolist().index(kind) for kind in ("sin", "cos"))
        kinds[sine], kinds[cosine] = "cos", "sin"

    document = read_document(mutate(report.path, tmp_path / "mutant.h5", turned))
    (found,) = differences(dataclasses.replace(report, document=document), made.config)
    assert found.what == "ODE" and not found.covers and "at 64 points" in found.proved


def test_workers_prove_the_same(path):
    assert check(path, processes=2).answer == "VERIFIED"


def test_no_switching_signal_leaves_what_is_proved_at_any_time(case):
    """Solutions by a fine Runge-Kutta method, w switching at up to 16 times the rate of the parts."""
    fine, slack, flow, tubes = 32, 1e-9, case.certificate.tubes.flow, case.certificate.tubes
    rng, w, loop = np.random.default_rng(0), case.disturbance, case.loop
    parts = int(flow.substeps[0])
    steps, per = loop.horizon * fine, fine // parts
    for c in range(2):
        low, high = case.cells.lower[c], case.cells.upper[c]
        count = 400
        x = low + torch.from_numpy(rng.uniform(size=(count, 3)).round()) * (high - low)
        every = rng.choice([steps, fine, per, per // 2, 4, 2, 1], count)
        signal = np.stack([np.repeat(rng.uniform(size=(steps, 3)).round(), e, axis=0)[:steps] for e in every])
        signal = w.lower + torch.from_numpy(signal) * (w.upper - w.lower)
        states, h, u = [x], loop.period / fine, x[:, :1]
        for i in range(steps):
            u = loop.control_given(None, x) if i % fine == 0 else u

            def rate(x, u=u, v=signal[:, i]):
                return loop.rate(x, u) + v

            a = rate(x)
            b = rate(x + h / 2 * a)
            d = rate(x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * d + rate(x + h * d))
            states.append(x)
        states = torch.stack(states, 1).numpy()
        at = states[:, ::fine]
        assert ((tubes.tube_lower[c] - slack <= at) & (at <= tubes.tube_upper[c] + slack)).all()
        pieces = states[:, :-1].reshape(count, loop.horizon, parts, per, 3)
        assert (flow.lower[c][:, :, None] - slack <= pieces).all() and (
            pieces <= flow.upper[c][:, :, None] + slack
        ).all()
        begin = pieces[:, :, 1:, 0]
        assert (flow.inner_lower[c] - slack <= begin).all() and (begin <= flow.inner_upper[c] + slack).all()
        s = np.arange(per)[:, None] / per
        ends = states[:, ::per]
        first, last = (
            side.reshape(count, loop.horizon, parts, 1, 3) for side in (ends[:, :-1], ends[:, 1:])
        )  # fmt: skip
        swing = loop.period / parts * (w.upper - w.lower).numpy()
        bulge = s * (1 - s) * (flow.curve[c][:, :, None] + swing) + 2 * flow.drift[c][:, :, None]
        assert (np.abs(pieces - first - s * (last - first)) <= bulge + slack).all()


def own_sets(document, c):
    """The checker's own boxes of a cell: at the instants ``(K+1, 2, n)``, and of controls and inner states."""
    tubes, found, flow = document.tubes, document.relaxations, document.flow
    with ctx.workprec(BITS):
        rest = [np.broadcast_to(tubes[f"disturbance_{s}"], flow["lower"][c].shape) for s in ("lower", "upper")]
        sides = [
            np.concatenate([w, w, flow[f"remainder_{s}"][c]], -1).reshape(document.horizon, -1)
            for w, s in zip(rest, ("lower", "upper"), strict=True)
        ]
        program = document.ode.step
        loop = Loop(Folded.of(program), document.windows(0), *sides)
        states = Zonotope.box(tubes["cell_lower"][c], tubes["cell_upper"][c])
        at, inner = [states.bounds()], []
        for k in range(document.horizon):
            columns = (found[name][c, k].tolist() for name in ("slope", "offset", "radius"))
            step = Step(loop, k, states, None, [Entry(*entry) for entry in zip(*columns, strict=True)])
            after, watched, _ = step.run()
            inner.append(step.output(program.control, step.bounds(watched)))
            states = step.image(after)
            at.append(step.output(program.next, states.bounds()))
            if "kept" in found:
                bits = np.unpackbits(found["kept"][c, k], bitorder="little")[: states.generators.shape[1]]
                states = states.reduced(bits.astype(bool))
        return [np.array([[[float(end) for end in side] for side in row] for row in rows]) for rows in (at, inner)]


def test_no_switching_signal_leaves_the_checkers_own_sets(case, path):
    """Those are what it proves with; the stored ones have to contain them."""
    document, fine, slack = read_document(path), 32, 1e-9
    rng, w, loop = np.random.default_rng(5), case.disturbance, case.loop
    steps, per, m = loop.horizon * fine, fine // int(case.certificate.tubes.flow.substeps[0]), 1
    for c in range(2):
        at, inner = own_sets(document, c)
        low, high = case.cells.lower[c], case.cells.upper[c]
        x = low + torch.from_numpy(rng.uniform(size=(600, 3)).round()) * (high - low)
        every = rng.choice([steps, fine, per, 4, 1], 600)
        signal = np.stack([np.repeat(rng.uniform(size=(steps, 3)).round(), e, axis=0)[:steps] for e in every])
        signal, h = w.lower + torch.from_numpy(signal) * (w.upper - w.lower), loop.period / fine
        for i in range(steps):
            k, inside = divmod(i, fine)
            if inside == 0:
                u = loop.control_given(None, x)
                assert (at[k][:, 0] - slack <= x.numpy()).all() and (x.numpy() <= at[k][:, 1] + slack).all()
                assert (inner[k][:m, 0] - slack <= u.numpy()).all() and (u.numpy() <= inner[k][:m, 1] + slack).all()
            elif inside == per:
                box = inner[k][m:]
                assert (box[:, 0] - slack <= x.numpy()).all() and (x.numpy() <= box[:, 1] + slack).all()

            def rate(x, u=u, v=signal[:, i]):
                return loop.rate(x, u) + v

            a = rate(x)
            b = rate(x + h / 2 * a)
            d = rate(x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * d + rate(x + h * d))
        assert (at[-1][:, 0] - slack <= x.numpy()).all() and (x.numpy() <= at[-1][:, 1] + slack).all()


def falsified(case, path, *, center, step, fraction, start=(0.05, 0.15, 0.0), w=(0.02, -0.1, 0.1)):
    """A certificate that says a solution under a constant signal is in the disc at some time."""
    config = copy.deepcopy(case.config)
    config["scene"]["obstacles"][0].update(center=center, radius=0.01)
    tubes = dataclasses.replace(
        case.certificate.tubes,
        verdict=("UNSAFE",),
        step=np.array([step]),
        fraction=np.array([fraction]),
        constraint=("disc",),
    )
    states = np.zeros((case.loop.horizon + 1, 3))
    states[0] = start
    example = Counterexample(
        reference=0, kind="collision", step=step, fraction=fraction, constraint="disc", depth=0.01, states=states,
        disturbances=np.tile(w, (case.loop.horizon, 1)),
    )  # fmt: skip
    made = dataclasses.replace(case.certificate, tubes=tubes, counterexamples=(example,), verdict="FALSIFIED")
    header = Header(stage="prove", experiment="vehicle", config=config)
    return write_artifact(path, made, header, overwrite=True)


def simulated(loop, start, w, until, fine=4096):
    """Where a solution under a constant signal is at some time."""
    x, w = (torch.tensor([v], dtype=torch.float64) for v in (start, w))
    h = loop.period / fine
    u = x[:, :1]
    for i in range(round(until / h)):
        u = loop.control_given(None, x) if i % fine == 0 else u
        a = loop.rate(x, u) + w
        x = x + h * (loop.rate(x + h / 2 * a, u) + w)
    return x[0].tolist()


def test_a_solution_that_is_in_an_obstacle_between_two_instants_is_proved_to_be(case, mutate, tmp_path):
    at = simulated(case.loop, (0.05, 0.15, 0.0), (0.02, -0.1, 0.1), 2.625 * case.loop.period)
    path = falsified(case, tmp_path / "certificate.h5", center=at[:2], step=2, fraction=0.625)
    report = check(path)
    assert report.answer == "FALSIFIED" and report.counterexamples == ((0, ""),)
    for step, fraction in ((2, 0.5), (2, 0.75), (1, 0.625), (3, 0.0), (0, 0.0), (2, 1.5), (2, np.nan), (4, 0.5)):

        def change(file, step=step, fraction=fraction):
            file["data/counterexamples/000000"].attrs.update(step=step, fraction=fraction)

        assert check(mutate(path, tmp_path / "mutant.h5", change)).answer == "UNKNOWN", (step, fraction)


def test_what_the_attack_refutes_the_checker_refutes(tmp_path):
    made = make_case(time="continuous", disc=[0.4, 0.45])
    found = verify_references(
        CellProver(Affine(), made.problem, made.tracker), torch.from_numpy(made.tubes.references), counts=[2, 1]
    )
    refuted = attack(
        found, made.problem, tracker=made.tracker, generator=torch.Generator().manual_seed(0),
        options=FalsifierOptions(restarts=4),
    )  # fmt: skip
    ((r, example),) = refuted.counterexamples
    examples = (counterexample_record(r, example, "disc"),)
    path = made.write(
        tmp_path / "certificate.h5", tubes=tubes_record(refuted.verification), verdict="FALSIFIED",
        counterexamples=examples,
    )  # fmt: skip
    report = check(path)
    assert report.answer == "FALSIFIED" and report.counterexamples == ((0, ""),)


def put(name, index, value):
    def change(file):
        data = file[f"data/tubes/flow/{name}"]
        data[index] = value(data[index])

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("upper", (1, 2, 0, 1), lambda v: v - 0.02), "cell 1, step 2: part 0: the flow of state 1"),
        (put("remainder_upper", (0, 1, 1, 2), lambda v: v * 0.5), "cell 0, step 1: part 1: the remainder of state 2"),
        (put("curve", (0, 0, 0, 0), lambda v: v * 0.5), "cell 0, step 0: part 0: the path of state 0 may bend more"),
        (put("drift", (1, 3, 1, 0), lambda v: v * 0.5), "cell 1, step 3: part 1: state 0 may drift farther"),
        (put("inner_upper", (0, 3, 0, 1), lambda v: v - 0.02), "cell 0, step 3: part 1: state 1 is only proved"),
        (put("drift", (1, 3, 1, 0), lambda v: np.nan), "finite"),
        (put("upper", (1, 3, 1, 0), lambda v: np.inf), "finite"),
    ],
)
def test_what_is_not_so_between_the_instants_is_named_with_its_part(change, message, path, mutate, tmp_path):
    report = check(mutate(path, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and message in report.findings[0].reason


def attribute(where, **values):
    return lambda file: file[where].attrs.update(values)


def divided(name, values):
    def change(file):
        file[f"data/tubes/flow/{name}"][...] = values

    return change


def without(name):
    return lambda file: file.__delitem__(name)


RATE = "data/loop/rate"


def kinked(file):
    kinds = file[f"{RATE}/kinds"]
    kinds[kinds.asstr()[()].tolist().index("sin")] = "relu"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (attribute("data/tubes", between="segments"), "needs 'between: continuous'"),
        (without("data/tubes/flow"), "needs 'between: continuous'"),
        (without(RATE), "needs 'between: continuous'"),
        (divided("substeps", [4, 4]), "must be float64 of shape"),
        (divided("substeps", [2, 1]), "of parts that a cell does not have"),
        (divided("substeps", [2, 0]), "of parts that a cell does not have"),
        (divided("order", [2, 0]), "the order is 0"),
        (divided("order", [2, -1]), "the order is -1"),
        (attribute("data/loop", dt=0.0), "the period is 0"),
        (lambda file: file["data/loop"].attrs.__delitem__("dt"), "needs dt"),
        (kinked, "'relu' stands in the right-hand side of the ODE"),
        (lambda file: file["data/tubes/flow"].create_dataset("more", data=[1.0]), "holds 'more'"),
    ],
)
def test_a_file_that_is_half_in_continuous_time_is_refused(change, message, path, mutate, tmp_path):
    with pytest.raises(ArtifactError, match=message):
        check(mutate(path, tmp_path / "mutant.h5", change))


def test_another_right_hand_side_is_another_claim_or_none(path, mutate, tmp_path):
    """A constant of the rate is part of the ODE: what is proved of one is not printed of another."""

    def faster(file):
        constant = next(i for i, k in enumerate(file[f"{RATE}/kinds"].asstr()[()]) if k == "constant")
        numbers = file[f"{RATE}/numbers"]
        numbers[constants_of(file, constant, RATE)] = numbers[constants_of(file, constant, RATE)] * 1.001

    report = check(mutate(path, tmp_path / "mutant.h5", faster))
    assert claim_rows(report.document) != claim_rows(check(path).document)
