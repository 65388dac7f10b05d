"""Observations of several parts: log-likelihoods add up, embeddings are joined, and one part is as none."""

from functools import partial

import pytest
import torch

from forbes import (
    Bernoulli,
    ConvDecoder,
    ConvEncoder,
    FlowBelief,
    ForbesError,
    GaussianBelief,
    MLPDecoder,
    MLPEncoder,
    Normal,
    ParticleModel,
    PartsDecoder,
    PartsEncoder,
    PartsLikelihood,
    StateSpaceModel,
    SymlogNormal,
    VectorModel,
    VectorNormal,
    WorldModel,
)

SHAPES = {"camera": (3, 8, 8), "mask": (1, 4, 5), "proprio": (4,)}
SINGLE = {"camera": Normal(0.5), "mask": Bernoulli(), "proprio": SymlogNormal(0.1)}
ENCODERS = {"camera": partial(ConvEncoder, channels=4), "mask": MLPEncoder, "proprio": partial(MLPEncoder, width=7)}
DECODERS = {"camera": partial(ConvDecoder, channels=4), "mask": MLPDecoder, "proprio": partial(MLPDecoder, width=7)}


def observations(*leading):
    generator = torch.Generator().manual_seed(0)
    return {
        "proprio": torch.randn(*leading, 4, generator=generator),
        "camera": torch.randint(256, (*leading, 3, 8, 8), generator=generator, dtype=torch.uint8),
        "mask": torch.randint(2, (*leading, 1, 4, 5), generator=generator, dtype=torch.uint8),
    }


def world(model=StateSpaceModel, **changes):
    torch.manual_seed(0)
    arguments = {
        "belief": GaussianBelief,
        "encoder": partial(PartsEncoder, parts=ENCODERS),
        "decoder": partial(PartsDecoder, parts=DECODERS),
        "likelihood": PartsLikelihood(SINGLE),
        "observation_shape": SHAPES,
        **{"action_dim": 2, "state_dim": 4, "hidden_dim": 8, "mlp_dim": 8},
    }
    return WorldModel(**(arguments | {"model": model} | changes))


def test_the_log_likelihood_is_the_sum_of_those_of_the_parts():
    likelihood, seen = PartsLikelihood(SINGLE).for_shape(SHAPES), observations(5, 6)
    target = likelihood.target(seen).double()
    output = torch.randn(target.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    start, total = 0, 0
    for name in sorted(SHAPES):  # the layout: flat, one after the other, by name
        size = torch.Size(SHAPES[name]).numel()
        there = slice(start, start + size)
        single = SINGLE[name].target(seen[name]).double()
        torch.testing.assert_close(target[..., there], single.flatten(2), rtol=0, atol=0)
        total = total + SINGLE[name].log_prob(output[..., there].unflatten(-1, SHAPES[name]), single)
        start += size

    assert start == target.shape[-1]
    torch.testing.assert_close(likelihood.log_prob(output, target), total)
    torch.testing.assert_close(sum(likelihood.log_prob_by_part(output, target).values()), total)


def test_means_and_pictures_of_the_parts_are_those_of_each():
    likelihood, seen = PartsLikelihood(SINGLE).for_shape(SHAPES), observations(5)
    output = likelihood.target(seen)

    means, pictures = likelihood.split(likelihood.mean(output)), likelihood.split(likelihood.picture(seen))

    for name, single in SINGLE.items():
        torch.testing.assert_close(means[name], single.mean(single.target(seen[name])), rtol=0, atol=0)
        torch.testing.assert_close(pictures[name], single.picture(seen[name]), rtol=0, atol=0)


def test_a_sample_of_the_parts_has_the_density_of_each():
    likelihood = PartsLikelihood({"one": VectorNormal(0.1), "two": VectorNormal(2.0)})
    likelihood = likelihood.for_shape({"one": (1,), "two": (1,)})
    torch.manual_seed(0)

    drawn = likelihood.sample(torch.zeros(10_000, 2))

    variance = drawn.var(0) / torch.tensor([0.01, 4.0])  # chi-square / n: standard deviation sqrt(2 / n)
    assert (variance - 1).abs().max() < 5 * (2 / 10_000) ** 0.5


def test_networks_of_one_part_are_those_networks():
    torch.manual_seed(0)
    joined = PartsEncoder({"camera": (3, 8, 8)}, {"camera": ConvEncoder})
    torch.manual_seed(0)
    single = ConvEncoder((3, 8, 8))
    image = torch.rand(5, 3, 8, 8)

    assert torch.equal(joined(image.flatten(1)), single(image))
    assert joined.embedding_dim == single.embedding_dim

    torch.manual_seed(0)
    joined = PartsDecoder(6, {"proprio": (4,)}, {"proprio": MLPDecoder})
    torch.manual_seed(0)
    single = MLPDecoder(6, (4,))
    assert torch.equal(joined(torch.ones(5, 6)), single(torch.ones(5, 6)))


def test_embeddings_and_outputs_are_joined_by_name():
    torch.manual_seed(0)
    encoder, decoder = PartsEncoder(SHAPES, ENCODERS), PartsDecoder(6, SHAPES, DECODERS)
    seen = {name: torch.rand(5, *shape) for name, shape in SHAPES.items()}
    flat = torch.cat([seen[name].flatten(1) for name in sorted(seen)], 1)

    embedding = torch.cat([each(seen[name]) for each, name in zip(encoder.encoders, sorted(seen), strict=True)], 1)

    torch.testing.assert_close(encoder(flat), embedding)
    output = torch.cat([each(torch.ones(5, 6)).flatten(1) for each in decoder.decoders], 1)
    torch.testing.assert_close(decoder(torch.ones(5, 6)), output)


@pytest.mark.parametrize("model", [StateSpaceModel, VectorModel, ParticleModel], ids=lambda kind: kind.__name__)
def test_a_model_of_one_part_is_the_model_of_that_array(model):
    """The same weights, noise and observations: the same bound, bit for bit."""
    size = {"model": model, "state_dim": 0 if model is VectorModel else 4}
    networks = {"encoder": MLPEncoder, "decoder": MLPDecoder, "likelihood": VectorNormal(0.1)}
    single = world(**networks, observation_shape=(4,), **size)
    joined = world(
        encoder=partial(PartsEncoder, parts={"proprio": MLPEncoder}),
        decoder=partial(PartsDecoder, parts={"proprio": MLPDecoder}),
        likelihood=PartsLikelihood({"proprio": VectorNormal(0.1)}),
        observation_shape={"proprio": (4,)},
        **size,
    )
    seen, action, mask = observations(5, 6)["proprio"], torch.zeros(5, 6, 2), torch.ones(5, 6, dtype=torch.bool)

    torch.manual_seed(0)
    expected = single.model.lower_bound(seen, action, mask).elbo
    torch.manual_seed(0)
    found = joined.model.lower_bound({"proprio": seen}, action, mask).elbo

    assert torch.equal(found, expected)


@pytest.mark.parametrize("model", [StateSpaceModel, VectorModel, ParticleModel], ids=lambda kind: kind.__name__)
def test_the_parts_of_a_bound_sum_to_its_reconstruction(model):
    module = world(model, state_dim=0 if model is VectorModel else 4)
    mask = torch.ones(5, 6, dtype=torch.bool)

    terms = module.model.lower_bound(observations(5, 6), torch.zeros(5, 6, 2), mask)
    measured = module.measures(terms)

    torch.testing.assert_close(sum(terms.parts.values()), terms.reconstruction)
    names = ["reconstruction/camera", "reconstruction/mask"]
    assert [name for name in measured if "/" in name] == [*names, "reconstruction/proprio"]
    number = {StateSpaceModel: ",S=1", VectorModel: "", ParticleModel: ",K=8"}[model]
    named = f"[camera=normal(0.5),mask=bernoulli,proprio=symlog-normal(0.1){number}]"
    assert module.model.bound_name.endswith(named)


def test_every_part_moves_the_belief_and_is_learned():
    module = world(belief=partial(FlowBelief, layers=2, width=8))
    seen, mask = observations(5, 6), torch.ones(5, 6, dtype=torch.bool)
    module.model.lower_bound(seen, torch.zeros(5, 6, 2), mask).elbo.mean().backward()

    for networks in (module.model.encoder.encoders, module.model.decoder.decoders):
        for network in networks:
            assert all(parameter.grad.abs().max() > 0 for parameter in network.parameters())


def test_a_center_is_the_mean_of_every_part():
    module = world(likelihood=PartsLikelihood(SINGLE | {"mask": Normal(), "proprio": VectorNormal()}), center=True)

    assert module.model.center.shape == (3 * 8 * 8 + 4 * 5 + 4,)
    with pytest.raises(ForbesError, match="center with the likelihood PartsLikelihood"):
        world(center=True)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"likelihood": Normal()}, "of one array, found observations of the parts camera, mask, proprio"),
        ({"encoder": MLPEncoder}, "MLPEncoder: found observations of the parts camera, mask, proprio"),
        ({"decoder": ConvDecoder}, "ConvDecoder: found .* Use PartsDecoder as model.decoder"),
        ({"encoder": partial(PartsEncoder, parts={"camera": ConvEncoder})}, "PartsEncoder: lacks mask, proprio, but"),
        (
            {"decoder": partial(PartsDecoder, parts=DECODERS | {"sound": MLPDecoder})},
            "PartsDecoder: has sound, but the observations have camera, mask, proprio",
        ),
        ({"likelihood": PartsLikelihood(SINGLE | {"proprio": Normal()})}, "that of proprio is a Normal, of .* rank 3"),
        ({"observation_shape": (3, 8, 8)}, "PartsLikelihood: found observations of shape .3, 8, 8., expected several"),
    ],
    ids=["likelihood", "encoder", "decoder", "missing", "unknown", "rank", "one array"],
)
def test_networks_that_do_not_fit_the_parts_are_refused(changes, sentence):
    with pytest.raises(ForbesError, match=sentence):
        world(**changes)
