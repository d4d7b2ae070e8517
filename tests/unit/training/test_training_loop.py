import numpy as np
import pytest
import torch
from torch import nn

from worldpose.errors import InputError
from worldpose.training.fine_tuning import Training, train
from worldpose.training.settings import TrainingSettings

SETTINGS = TrainingSettings(steps=12, check_every=4, rate=0.05, seed=3)


class InterruptedTrainingError(Exception):
    pass


def line_fit(settings=SETTINGS, *, interrupted_after=None, scores=None):
    """A small net, in the memory layout of the shipped ones, that learns y = 2 x."""
    torch.manual_seed(settings.seed)
    net = nn.Sequential(nn.BatchNorm2d(2), nn.Conv2d(2, 2, 3, padding=1))
    net = net.to(memory_format=torch.channels_last)
    drawn = []

    def batch(rng):
        drawn.append(None)
        if interrupted_after is not None and len(drawn) > interrupted_after:
            raise InterruptedTrainingError
        return torch.from_numpy(rng.standard_normal((8, 2, 4, 4)).astype(np.float32))

    def score(net):
        if scores is not None:
            return scores.pop(0)
        x = torch.linspace(-1, 1, 64).reshape(2, 2, 4, 4)
        with torch.no_grad():
            return -float((net(x) - 2 * x).square().mean())

    return Training(net, batch, lambda net, x: (net(x) - 2 * x).square().mean(), score, settings)


def test_a_resumed_training_gives_the_weights_of_an_undisturbed_one(tmp_path):
    whole, first, second = line_fit(), line_fit(interrupted_after=6), line_fit()
    undisturbed = train(whole)
    checkpoint = tmp_path / "training.checkpoint"
    with pytest.raises(InterruptedTrainingError):
        train(first, checkpoint)
    lines = []
    resumed = train(second, checkpoint, lines.append)
    assert lines[0] == "resumes after step 4"
    # The loss before the first step is NaN.
    assert [(c.step, c.score) for c in resumed] == [(c.step, c.score) for c in undisturbed]
    assert [c.loss for c in resumed[1:]] == [c.loss for c in undisturbed[1:]]
    theirs = second.net.state_dict()
    for name, value in whole.net.state_dict().items():
        assert torch.equal(value, theirs[name]), name


def test_the_best_weights_are_kept_and_training_stops_early():
    # Without memory the mean is the weights of the step.
    changes = {"steps": 100, "check_every": 1, "patience": 2, "memory": 0.0}
    settings = SETTINGS.model_copy(update=changes)
    training = line_fit(settings, scores=[0.1, 0.5, 0.4, 0.3, 0.9])
    best = {}

    def say(line):
        if line.startswith("step 1 "):
            best.update({k: v.clone() for k, v in training.net.state_dict().items()})

    checks = train(training, progress=say)
    assert [check.step for check in checks] == [0, 1, 2, 3]
    for name, value in training.net.state_dict().items():
        assert torch.equal(value, best[name]), name


def test_what_is_no_checkpoint_of_this_training_is_refused(tmp_path):
    checkpoint = tmp_path / "training.checkpoint"
    train(line_fit(), checkpoint)
    with pytest.raises(InputError, match="settings"):
        train(line_fit(SETTINGS.model_copy(update={"rate": 0.1})), checkpoint)
    for content in (b"", b"\x80\x04cos\nsystem\n", b"{}"):
        checkpoint.write_bytes(content)
        with pytest.raises(InputError, match="checkpoint"):
            train(line_fit(), checkpoint)
