"""PSNR and SSIM of open-loop predictions: their definitions, their limits, and what they do not depend on."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

import forbes
from forbes.data import SequenceBatch
from forbes.evaluation.image_scores import futures_of, image_curves, image_rows, score_images
from forbes.evaluation.predictions import complete, expected_frames
from forbes.seeding import derive_seed, forked

CONTEXT = 3


@pytest.fixture(scope="module")
def strokes(strokes_file):
    """Written digits, as drawings so far, and an untrained model of them."""
    data = forbes.SequenceDataModule(forbes.Strokes(path=str(strokes_file), validation=20), length=8)
    torch.manual_seed(0)
    return data, forbes.WorldModel.for_data(data, hidden_dim=8, mlp_dim=8).eval().model


def batches(data, size):
    """The test digits in batches of a size."""
    for index in torch.arange(12).split(size):
        yield int(index[0]), data.sequences("test", index)


def images(*frames):
    """A batch of one sequence of images."""
    observation = torch.stack(frames)[None]  # (1, T, C, H, W)
    steps = observation.shape[:2]
    return SequenceBatch(
        observation, torch.zeros(*steps, 0), torch.zeros(steps), torch.ones(steps).bool(), torch.zeros(*steps, 0),
        torch.zeros(steps).bool(),
    )  # fmt: skip


def ssim(one, other):
    """The definition for one grey image in [0, 1]: a Gaussian window of 11 pixels, mirrored at the edges."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps /= taps.sum()

    def mean(values):
        return correlate1d(correlate1d(values, taps, axis=0, mode="mirror"), taps, axis=1, mode="mirror")

    x, y = mean(one), mean(other)
    xx, yy, xy = mean(one * one) - x * x, mean(other * other) - y * y, mean(one * other) - x * y
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * x * y + c1) * (2 * xy + c2) / ((x * x + y * y + c1) * (xx + yy + c2))).mean()


def test_the_psnr_pools_squared_errors_and_the_ssim_averages(strokes):
    data, model = strokes

    found = score_images(model, data.source, batches(data, 12), CONTEXT, futures=4, seed=1)

    (_, batch) = next(batches(data, 12))
    with forked("cpu", derive_seed(1, "image scores", 0)):
        expected = expected_frames(model, data.source, batch, CONTEXT, 4)  # (B, T - c, 1, H, W)
    truth = data.source.pictures(batch.observation).double()  # (B, T, 1, H, W)
    last = truth[:, CONTEXT - 1 : CONTEXT].expand_as(expected)
    for name, predicted in (("model", expected.double()), ("last frame", last)):
        for step in range(8 - CONTEXT):
            rows = batch.mask[:, CONTEXT + step]
            one, other = predicted[rows, step, 0], truth[rows, CONTEXT + step, 0]
            psnr = -10 * math.log10((one - other).square().mean())
            assert found[name].psnr[step] == pytest.approx(psnr, rel=1e-4)
            similarity = np.mean([ssim(*pair) for pair in zip(one.numpy(), other.numpy(), strict=True)])
            assert found[name].ssim[step] == pytest.approx(similarity, abs=1e-4)


def test_the_reference_does_not_depend_on_the_batches(strokes):
    data, model = strokes

    one, several = (score_images(model, data.source, batches(data, size), CONTEXT, 1)["last frame"] for size in (12, 5))

    assert one.psnr == pytest.approx(several.psnr)
    assert one.ssim == pytest.approx(several.ssim)


def test_padding_is_not_scored(strokes):
    data, model = strokes
    (_, batch) = next(batches(data, 12))
    assert not batch.mask.all()
    noise = torch.randint(0, 2, batch.observation.shape, dtype=torch.uint8)
    changed = batch._replace(observation=batch.observation.where(batch.mask[:, :, None, None, None], noise))

    scores = [score_images(model, data.source, [(0, each)], CONTEXT, 2) for each in (batch, changed)]

    assert scores[0] == scores[1]


def test_nothing_moves_and_the_last_frame_is_exact():
    torch.manual_seed(0)
    frame = torch.randint(0, 256, (1, 12, 12), dtype=torch.uint8)
    still = forbes.Replay.__new__(forbes.Replay)  # a source of images; nothing is read from it
    still.observation_shape, still.increments = (1, 12, 12), False
    model = forbes.WorldModel(observation_shape=(1, 12, 12), hidden_dim=4, mlp_dim=4, state_dim=2).eval().model

    found = score_images(model, still, [(0, images(*[frame] * 4))], 2, 2)

    assert found["last frame"].psnr == [math.inf] * 2
    assert found["last frame"].ssim == pytest.approx([1.0] * 2)
    curves = {metric: values for metric, _, values in image_curves(found)}
    assert curves["psnr"]["last frame"] == [None, None]
    assert all(map(math.isfinite, curves["psnr"]["model"]))


def test_images_too_small_for_the_window_have_no_ssim():
    frame = torch.zeros(1, 5, 12, dtype=torch.uint8)
    small = forbes.Replay.__new__(forbes.Replay)
    small.observation_shape, small.increments = (1, 5, 12), False
    model = forbes.WorldModel(observation_shape=(1, 5, 12), hidden_dim=4, mlp_dim=4, state_dim=2).eval().model

    found = score_images(model, small, [(0, images(*[frame] * 3))], 2, 2)

    assert found["model"].ssim is None
    assert [metric for metric, _, _ in image_curves(found)] == ["psnr"]


def test_the_expected_frame_is_the_mean_of_completions(strokes):
    data, model = strokes
    batch = data.sequences("test", torch.arange(8))

    torch.manual_seed(0)
    expected = expected_frames(model, data.source, batch, CONTEXT, 3)

    torch.manual_seed(0)
    means = [complete(model, data.source, batch, CONTEXT, samples=1, mean=True).frames[0] for _ in range(3)]
    torch.testing.assert_close(expected, torch.stack(means).mean(0))


def test_a_model_without_randomness_has_one_future(strokes):
    data, _ = strokes
    batch = data.sequences("test", torch.arange(8))
    model = forbes.WorldModel.for_data(data, model=forbes.VectorModel, state_dim=0, hidden_dim=8, mlp_dim=8).model

    few, many = (expected_frames(model, data.source, batch, CONTEXT, futures) for futures in (1, 50))

    torch.testing.assert_close(few, many)


def test_futures_come_in_whole_sets_and_batches_are_bounded():
    class Particles:
        particles = 7

    assert futures_of(Particles(), 700) == 98
    assert futures_of(Particles(), 14) == 14
    Particles.particles = 128
    assert futures_of(Particles(), 1024) == 128
    assert image_rows(15) == 66
    assert image_rows(2000) == 1
