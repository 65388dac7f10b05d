"""The loss against numbers worked out by hand."""

import pytest
import torch

from forbes.models import ElboTerms, elbo_loss


def terms(kl=((1.0, 5.0), (2.0, 4.0)), analytic=None, mask=((True, True), (True, True))):
    """Two sequences of two steps, each step with log-likelihood -10."""
    kl = torch.tensor(kl, requires_grad=True)
    return ElboTerms(
        torch.full((2, 2), -10.0), kl, None if analytic is None else torch.tensor(analytic), torch.tensor(mask)
    )


def test_bound_of_a_sequence_is_the_sum_over_its_steps():
    assert terms().elbo.tolist() == [-26, -26]  # -10 - 1 - 10 - 5, -10 - 2 - 10 - 4


def test_padding_is_left_out_of_bound_and_loss():
    padded = terms(mask=((True, False), (True, True)))

    assert padded.elbo.tolist() == [-11, -26]
    assert elbo_loss(padded).item() == pytest.approx(10 + (1 + 2 + 4) / 3)


@pytest.mark.parametrize(
    ("free_nats", "per", "divergence"),
    [
        (0.0, "batch", 3),  # (1 + 5 + 2 + 4) / 4
        (2.5, "batch", 3),
        (3.5, "batch", 3.5),
        (0.0, "element", 3),
        (2.5, "element", 3.5),  # (2.5 + 5 + 2.5 + 4) / 4
        (4.5, "element", 4.625),  # (4.5 + 5 + 4.5 + 4.5) / 4
    ],
)
def test_free_nats_bound_the_mean_or_each_step(free_nats, per, divergence):
    assert elbo_loss(terms(), free_nats, per).item() == pytest.approx(10 + divergence)


@pytest.mark.parametrize(
    ("free_nats", "per", "gradient"),
    [
        (2.5, "batch", [[0.25, 0.25], [0.25, 0.25]]),
        (3.5, "batch", [[0, 0], [0, 0]]),
        (2.5, "element", [[0, 0.25], [0, 0.25]]),
    ],
)
def test_a_free_divergence_has_no_gradient(free_nats, per, gradient):
    batch = terms()

    elbo_loss(batch, free_nats, per).backward()

    assert batch.kl.grad.tolist() == gradient


def test_padding_does_not_count_as_free():
    """With 3 nats free per step the padded step's 100 nats must neither raise the mean nor take a share of it."""
    padded = terms(kl=((1.0, 100.0), (2.0, 6.0)), mask=((True, False), (True, True)))

    assert elbo_loss(padded, 3.0, "batch").item() == pytest.approx(10 + 3)
    assert elbo_loss(padded, 3.0, "element").item() == pytest.approx(10 + (3 + 3 + 6) / 3)


def test_the_weight_scales_the_divergence_only():
    assert elbo_loss(terms(), kl_weight=0.5).item() == pytest.approx(10 + 1.5)
    assert elbo_loss(terms(), free_nats=3.5, kl_weight=0.5).item() == pytest.approx(10 + 1.75)


def test_loss_uses_the_closed_form_and_the_bound_the_sample():
    both = terms(analytic=((2.0, 2.0), (2.0, 2.0)))

    assert elbo_loss(both).item() == pytest.approx(10 + 2)
    assert both.elbo.tolist() == [-26, -26]
