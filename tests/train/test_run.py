"""A run that is interrupted, killed or crashes anywhere and is resumed gives the bits of one
that was not."""

import json
import os
import pickle
import signal
import time
from dataclasses import replace

import pytest
import tiny_training
import torch
from safetensors.torch import save_file
from tiny_training import (
    STEPS,
    StubData,
    StubObjective,
    assert_same_run,
    rows,
    run,
    script,
    send,
    stub_config,
    stub_model,
    weights_of,
)
from torch import nn

from recon.mbir.weights_io import TensorFileError, read_tensors
from torchpcct.files import FolderInUseError, alone
from train.checkpoint import CHECKPOINT_FORMAT, CheckpointStore
from train.config import ObjectiveConfig
from train.loop import train
from train.run import DivergedError, rate_factor


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_resumed_run_is_bit_for_bit_the_uninterrupted_one(tmp_path, uninterrupted, number):
    """Interrupted twice: in the middle, and in the step before a validation."""
    before = signal.getsignal(number)
    for step, resume in ((3, False), (8, True)):
        state, caught = run(
            tmp_path / "x", objective=StubObjective({step: send(number)}), resume=resume
        )
        assert caught == number
        # The signal came during step number `step` (from 0); all processes agree on it in the next
        # one.
        assert state.step == step + 2
    assert signal.getsignal(number) is before
    assert run(tmp_path / "x", resume=True)[0].step == STEPS
    assert_same_run(tmp_path / "x", uninterrupted)


def test_run_with_soap_is_resumed_bit_for_bit(tmp_path):
    """Its bases are part of the checkpoint."""
    config = stub_config(optimiser="soap")
    run(tmp_path / "x", config)
    run(tmp_path / "y", config, objective=StubObjective({4: send(signal.SIGTERM)}))
    assert run(tmp_path / "y", config, resume=True)[0].step == STEPS
    assert_same_run(tmp_path / "x", tmp_path / "y")


def test_run_of_one_optimiser_is_not_resumed_with_another(tmp_path):
    run(tmp_path / "x", objective=StubObjective({4: send(signal.SIGTERM)}))
    with pytest.raises(ValueError, match=r"another configuration \(optimiser\)"):
        run(tmp_path / "x", stub_config(optimiser="soap"), resume=True)


def test_finished_run_resumed_changes_nothing(tmp_path, uninterrupted):
    run(tmp_path / "x")
    objective = StubObjective()
    assert run(tmp_path / "x", objective=objective, resume=True)[0].step == STEPS
    assert objective.validations == 0
    assert_same_run(tmp_path / "x", uninterrupted)


@pytest.mark.extended
def test_killed_run_resumed(tmp_path, uninterrupted):
    """SIGKILL at an arbitrary moment: the log ran ahead of the checkpoint, and is cut back."""
    out = tmp_path / "x"
    process = script(tiny_training.__file__, "slow", str(out))
    try:
        log, deadline = out / "log.csv", time.monotonic() + 600
        while not (log.exists() and len(log.read_text().splitlines()) > 7):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.002)
    finally:
        process.kill()
        process.wait()
    reached = int(rows(log)[-1]["step"])
    state = CheckpointStore(out).load()[1]["state"]
    assert 0 < state["step"] <= reached < STEPS
    run(out, resume=True)
    assert_same_run(out, uninterrupted)


class Crash(BaseException):
    pass


@pytest.fixture
def crash_before(monkeypatch):
    """A function that runs the training, which ends right before the n-th rename onto a name, as
    if it were killed."""

    def crash(out, name, n, resume):
        real, left = os.replace, [n]

        def replace(source, target):
            left[0] -= os.path.basename(target) == name
            if left[0] == 0:
                raise Crash
            real(source, target)

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", replace)
            with pytest.raises(Crash):
                run(out, stub_config(checkpoint_seconds=1e-9), resume=resume)

    return crash


@pytest.mark.parametrize("name", ["checkpoint.next.safetensors", "checkpoint.safetensors"])
def test_crash_before_the_first_checkpoint(tmp_path, crash_before, name):
    """There is nothing to resume, and nothing has been trained."""
    crash_before(tmp_path / "x", name, 1, resume=False)
    with pytest.raises(TensorFileError, match="no checkpoint to resume from"):
        run(tmp_path / "x", resume=True)
    assert not (tmp_path / "x" / "log.csv").exists()


def test_crash_at_any_write(tmp_path, uninterrupted, crash_before):
    """One run crashes at every kind of write, one after the other: it always continues to the same
    result.

    Every file is written aside, flushed and renamed, so what lies on the disk changes in the
    renames only.
    """
    out = tmp_path / "x"
    crash_before(out, "log.csv", 1, resume=False)
    for name, n in (
        ("checkpoint.next.safetensors", 1),
        ("checkpoint.next.safetensors", 3),
        ("checkpoint.previous.safetensors", 2),
        ("checkpoint.safetensors", 2),
        ("a b_000005.png", 1),
        ("validation.csv", 1),
        ("weights.safetensors", 1),
        ("log.csv", 1),
        ("card.json", 1),
        ("training.md", 1),
    ):
        # As a killed process leaves them.
        for leftover in ("checkpoint.next.safetensors", ".123-0a1b2c-00000000.part.training.md"):
            (out / leftover).write_bytes(b"half")
        crash_before(out, name, n, resume=True)
    run(out, resume=True)
    assert_same_run(out, uninterrupted)
    assert not [p for p in out.iterdir() if "part" in p.name or "next" in p.name]


DAMAGE = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3]),
    "flip": lambda path: path.write_bytes(
        (data := path.read_bytes())[:-10] + bytes([data[-10] ^ 1]) + data[-9:]
    ),
    "missing": lambda path: path.unlink(),
    "foreign": lambda path: save_file({"model.0.weight": torch.zeros(3)}, path),
    "pickle": lambda path: path.write_bytes(pickle.dumps({"model": [1.0]})),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_checkpoint_falls_back_to_the_previous_one(tmp_path, uninterrupted, damage, caplog):
    out = tmp_path / "x"
    run(out, objective=StubObjective({6: send(signal.SIGTERM)}))
    store, spoil = CheckpointStore(out), DAMAGE[damage]
    older = read_tensors(store.previous, CHECKPOINT_FORMAT)[1]["state"]["step"]
    spoil(store.current)
    metadata, warning = store.load()[1:]
    assert metadata["state"]["step"] == older
    assert "checkpoint.safetensors" in warning
    both = tmp_path / "both"
    both.mkdir()
    for path in (store.current, store.previous):
        if path.exists():
            (both / path.name).write_bytes(path.read_bytes())
    spoil(both / store.previous.name)
    with pytest.raises(
        TensorFileError, match=r"checkpoint.safetensors .*checkpoint.previous.safetensors "
    ):
        run(both, resume=True)
    with caplog.at_level("INFO", logger="train"):
        run(out, resume=True)
    assert "continuing from the previous checkpoint" in caplog.text
    assert_same_run(out, uninterrupted)


def test_resume_refuses_another_configuration_or_model(tmp_path, caplog):
    run(tmp_path / "x", objective=StubObjective({1: send(signal.SIGTERM)}))
    with pytest.raises(ValueError, match=r"learning_rate, objective\.edge"):
        run(
            tmp_path / "x",
            stub_config(learning_rate=1.0, objective=ObjectiveConfig(edge=0.1)),
            resume=True,
        )
    with pytest.raises(TensorFileError, match="another model"):
        train(
            stub_config(),
            nn.Linear(6, 1),
            StubData(),
            StubData(),
            StubObjective(),
            tmp_path / "x",
            resume=True,
        )
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(threads + 1)
        with caplog.at_level("INFO", logger="train"):
            assert (
                run(tmp_path / "x", stub_config(checkpoint_seconds=3.0), resume=True)[0].step
                == STEPS
            )
    finally:
        torch.set_num_threads(threads)
    assert f"threads {threads} → {threads + 1}" in caplog.text


def test_folder_in_use_is_refused(tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="--resume"):
        run(tmp_path)
    with pytest.raises(TensorFileError, match="no checkpoint to resume from"):
        run(tmp_path / "nothing", resume=True)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


def test_two_runs_at_once_in_one_folder_are_refused(tmp_path):
    """Begun twice, or resumed while it still runs: they would write each other's checkpoints."""
    (tmp_path / "x").mkdir()
    with alone(tmp_path / "x"):
        for resume in (False, True):
            with pytest.raises(FolderInUseError, match="another process writes into"):
                run(tmp_path / "x", resume=resume)
    assert list((tmp_path / "x").iterdir()) == []


# Optimisation


def test_learning_rate_follows_the_updates():
    config = stub_config(steps=1000, warmup=10, final_fraction=0.1)
    assert rate_factor(config, 0) == pytest.approx(0.1)
    assert rate_factor(config, 9) == 1.0
    assert rate_factor(config, 10) == 1.0
    assert rate_factor(config, 505) == pytest.approx(0.55, abs=1e-3)
    assert rate_factor(config, 999) == pytest.approx(0.1, abs=1e-4)
    assert rate_factor(stub_config(steps=1, warmup=0), 0) == 1.0
    late = stub_config(steps=1000, warmup=10, decay=0.2, final_fraction=0.1)
    assert rate_factor(late, 9) == rate_factor(late, 800) == 1.0
    assert rate_factor(late, 900) == pytest.approx(0.55)
    assert rate_factor(late, 1000) == pytest.approx(0.1)


def test_a_run_may_be_made_longer_until_the_rate_falls(tmp_path):
    """It then gives the bits of one that was as long from the start."""
    long, short = (stub_config(steps=n, decay=0.25, unroll=1) for n in (2 * STEPS, STEPS))
    run(tmp_path / "long", long)
    run(tmp_path / "x", short, StubObjective({6: send(signal.SIGTERM)}))
    run(tmp_path / "x", long, resume=True)
    assert_same_run(tmp_path / "x", tmp_path / "long")
    run(tmp_path / "y", short, StubObjective({9: send(signal.SIGTERM)}))
    with pytest.raises(ValueError, match="steps"):
        run(tmp_path / "y", long, resume=True)


def test_what_comes_at_the_end_may_change_until_it_begins(tmp_path):
    """Late scenes, and the weight of constant tissue: not after their first step, nor the number
    of steps, of which they are shares."""
    late = {"begins": 0.75, "scenes": {"core_probability": 1.0}}
    run(tmp_path / "x", objective=StubObjective({4: send(signal.SIGTERM)}))
    run(
        tmp_path / "x",
        stub_config(late=late),
        StubObjective({11: send(signal.SIGTERM)}),
        resume=True,
    )
    other = {"begins": 0.75, "scenes": {"core_probability": 0.5}}
    with pytest.raises(ValueError, match=r"late\.scenes\.core_probability"):
        run(tmp_path / "x", stub_config(late=other), resume=True)
    plain = ObjectiveConfig(flat=1.0, end_from=0.75)
    flat = [
        stub_config(steps=n, decay=0.0, unroll=1, objective=replace(plain, end_from=f))
        for n, f in ((STEPS, 0.75), (2 * STEPS, 0.75), (STEPS, 0.9))
    ]
    run(tmp_path / "y", flat[0], StubObjective({1: send(signal.SIGTERM)}))
    heavier = replace(flat[0], objective=replace(plain, flat=2.0))
    biased = replace(flat[0], objective=replace(plain, lesion_bias=(0.0, 2.0)))
    shown = replace(flat[0], objective=replace(plain, contrast_end=2.0, empty=1.0))
    for step, changed in ((3, heavier), (5, biased), (7, shown)):
        run(tmp_path / "y", changed, StubObjective({step: send(signal.SIGTERM)}), resume=True)
    run(tmp_path / "y", flat[2], StubObjective({10: send(signal.SIGTERM)}), resume=True)
    with pytest.raises(ValueError, match="steps"):
        run(tmp_path / "y", flat[1], resume=True)


def test_it_trains_and_the_best_average_is_shipped(uninterrupted):
    validations = rows(uninterrupted / "validation.csv")
    assert [r["step"] for r in validations] == ["5", "10", "12"]
    scores = [float(r["score"]) for r in validations]
    assert scores[-1] > scores[0]
    weights, header = weights_of(uninterrupted)
    assert header["score"] == max(scores)
    model = stub_model(5).eval()
    model.load_state_dict(weights)
    assert StubObjective().validate(model, StubData()).score == pytest.approx(max(scores), rel=1e-5)
    first, last = (rows(uninterrupted / "log.csv")[i] for i in (0, -1))
    assert list(first) == ["step", "lr", "grad_norm", "skipped", "loss", "square", "scenes"]
    assert float(first["scenes"]) == 1.0
    assert float(first["lr"]) == pytest.approx(0.02 / 3)
    assert last["step"] == str(STEPS)


def test_weights_of_a_part_of_the_loss_do_not_ship(tmp_path):
    """However good their score was: what comes later may cost some of it."""

    class Falling(StubObjective):
        def validate(self, model, held_out):
            return replace(super().validate(model, held_out), score=-float(self.validations))

    for end_from, step in ((0.5, 10), (5 / STEPS, 10), (0.0, 5)):
        config = stub_config(objective=ObjectiveConfig(flat=1.0, end_from=end_from))
        out = tmp_path / str(end_from)
        run(out, config, Falling())
        assert json.loads((out / "card.json").read_text())["step"] == step


def test_average_of_weights(tmp_path):
    """The average is the recursion over the weights of every step."""
    seen = []

    class Watch(StubObjective):
        def __call__(self, model, batch, progress):
            seen.append(model[0].weight.detach().clone())
            return super().__call__(model, batch, progress)

    run(tmp_path / "x", objective=Watch())
    tensors, _, _ = CheckpointStore(tmp_path / "x").load()
    expected = seen[0]
    for step, weight in enumerate([*seen[1:], tensors["model.0.weight"]]):
        decay = min(0.9, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * weight
    torch.testing.assert_close(tensors["average.module.0.weight"], expected, rtol=1e-5, atol=1e-6)


def test_long_gradients_are_shortened(tmp_path):
    """Adam forgets a common factor of all gradients: compare the first moments after one step."""
    moments = {}
    for clip in (1e-3, float("inf")):
        out = tmp_path / str(clip)
        run(out, stub_config(steps=1, clip=clip))
        tensors = CheckpointStore(out).load()[0]
        moments[clip] = torch.cat(
            [v.flatten() for k, v in tensors.items() if k.endswith(".exp_avg")]
        )
    norm = float(rows(out / "log.csv")[0]["grad_norm"])
    assert float(moments[1e-3].norm()) == pytest.approx(0.1 * 1e-3, rel=1e-4)
    torch.testing.assert_close(
        moments[1e-3], moments[float("inf")] * (1e-3 / norm), rtol=1e-4, atol=1e-9
    )


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_steps_that_are_not_finite_are_skipped(tmp_path, bad):
    """They count as steps, but nothing moves in them; nor does resuming after them."""
    spoil = {0: lambda t: t * bad, 6: lambda t: t * bad, 7: lambda t: t + float("inf")}
    state, _ = run(tmp_path / "x", objective=StubObjective(spoil))
    assert (state.step, state.skipped) == (STEPS, 3)
    tensors, _, _ = CheckpointStore(tmp_path / "x").load()
    assert all(torch.isfinite(t).all() for t in tensors.values())
    table = rows(tmp_path / "x" / "log.csv")
    assert [r["skipped"] for r in table[5:9]] == ["1", "2", "3", "3"]
    assert table[6]["lr"] == table[7]["lr"] == table[8]["lr"] != table[9]["lr"]
    assert json.loads((tmp_path / "x" / "card.json").read_text())["steps_skipped"] == 3
    run(
        tmp_path / "y",
        objective=StubObjective({**spoil, 6: lambda t: send(signal.SIGTERM)(t) * bad}),
    )
    run(tmp_path / "y", resume=True)
    assert_same_run(tmp_path / "x", tmp_path / "y")


def test_diverged_run_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr("train.run.PATIENCE", 3)
    at = {k: (lambda t: t * float("nan")) for k in range(2, STEPS)}
    with pytest.raises(DivergedError, match=r"3 steps in a row, up to step 5: .*since step 2"):
        run(tmp_path / "x", objective=StubObjective(at))
