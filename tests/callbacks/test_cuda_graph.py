"""A recorded update: elementwise functions that the compiler fuses, and, where there is a GPU, the playback."""

import json
import pickle
from contextlib import contextmanager, nullcontext
from functools import partial

import pytest
import torch
from batches import batch_of
from lightning import LightningModule
from small_agents import fit, write_config

import forbes.performance.fusion
from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.callbacks import CudaGraph, cuda_graph
from forbes.callbacks.cuda_graph import Recording
from forbes.data import SequenceBatch
from forbes.errors import ForbesError
from forbes.models import ConvDecoder, ConvEncoder
from forbes.performance.fusion import fused, fusing
from forbes.training import ImaginationActorCritic
from forbes.training.acting import AgentPolicy
from forbes.training.world_model import LossTerm

BATCH, TIME = 3, 4
# The compiler looks at gradients that are not there.
pytestmark = pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")
on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="a CUDA graph needs a GPU")


@pytest.fixture(params=[GaussianBelief, partial(FlowBelief, layers=3, width=8)], ids=["gaussian", "flow"], name="agent")
def agent_fixture(request):
    torch.manual_seed(0)
    agent = ImaginationActorCritic(
        trajectories=2,
        horizon=3,
        control_dim=8,
        belief=request.param,
        encoder=partial(ConvEncoder, channels=2),
        decoder=partial(ConvDecoder, channels=2),
        observation_shape=(3, 28, 28),
        action_dim=2,
        state_dim=4,
        hidden_dim=6,
        mlp_dim=8,
        free_nats=0.0,
        learning_rate=1e-3,
    )
    with torch.no_grad():  # an untrained flow is the identity, and nothing would be compared
        for parameter in agent.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return agent


def make_batch(seed):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randint(256, (BATCH, TIME, 3, 28, 28), dtype=torch.uint8, generator=generator)
    action, reward = torch.rand(BATCH, TIME, 2, generator=generator), torch.rand(BATCH, TIME, generator=generator)
    return batch_of(observation, action, reward)


def results(total_loss, agent, batch):
    """Give loss, what is logged, and all gradients, with the noise of one seed."""
    torch.manual_seed(1)
    loss, values = total_loss(batch)
    return loss.detach().clone(), values, torch.autograd.grad(loss, list(agent.parameters()))


def trained(folder, name, *changes):
    """Train a small agent through the command line; give the losses that its log has, by update."""
    config = folder / f"{name}.yaml"
    text = write_config(folder).read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    config.write_text(text)
    assert fit("--config", config, "--run_dir", folder / name) == 0
    rows = [json.loads(line) for line in (folder / name / "metrics.jsonl").read_text().splitlines()]
    found = [{key: value for key, value in row.items() if key.startswith("train/")} for row in rows]
    assert any(found)
    return found


WITH = ("  callbacks:\n", "  callbacks:\n    - {class_path: CudaGraph}\n")
OVERLAP = ("seed_episodes: 2,", "seed_episodes: 2, overlap: true,")


def test_fused_functions_compile_and_keep_values_and_gradients(agent, monkeypatch):
    compiled = []

    def compile_without_code(function):
        compiled.append(function.__name__)
        return torch.compile(function, fullgraph=True, dynamic=False, backend="aot_eager")

    monkeypatch.setattr(forbes.performance.fusion, "_compiled", compile_without_code)
    plain = results(agent.total_loss, agent, make_batch(0))

    with fusing():
        fused_ones = results(agent.total_loss, agent, make_batch(0))

    torch.testing.assert_close(fused_ones, plain)
    assert {"after_sum", "_squeeze", "lambda_returns"} <= set(compiled)


def test_outside_nothing_is_compiled(monkeypatch):
    monkeypatch.setattr(forbes.performance.fusion, "_compiled", lambda _: pytest.fail("compiled"))

    assert fused(torch.relu)(torch.ones(())) == 1


def test_on_a_cpu_the_callback_changes_nothing(tmp_path):
    on_cpu = ("trainer:\n", "trainer:\n  accelerator: cpu\n")

    assert trained(tmp_path, "with", WITH, on_cpu) == trained(tmp_path, "without", on_cpu)


def test_a_loss_that_changes_by_itself_is_refused(tmp_path, capsys):
    config = write_config(tmp_path)
    config.write_text(config.read_text().replace(*WITH))

    assert fit("--config", config, "--model.kl_warmup", 10, "--run_dir", tmp_path / "run") == 2
    assert "CudaGraph: kl_warmup changes the loss between updates, expected 0" in capsys.readouterr().err


def test_what_is_no_world_model_is_refused():
    with pytest.raises(ForbesError, match="CudaGraph: found a LightningModule, expected a WorldModel or an agent"):
        CudaGraph().on_fit_start(None, LightningModule())


def test_an_agent_for_another_process_drops_the_recording(agent):
    agent.recorded = lambda _: None

    copied = AgentPolicy.as_it_is(agent, exploring=True).agent

    assert copied.recorded is None
    assert agent.recorded is not None  # the one that learns keeps it
    pickle.dumps(copied)


def test_a_training_step_takes_the_recorded_loss(agent, monkeypatch):
    logged = {}
    monkeypatch.setattr(agent, "log_dict", lambda values, batch_size: logged.update(values))
    agent.recorded = lambda batch: LossTerm(torch.tensor(float(len(batch.mask))), {"of": torch.tensor(7.0)})

    assert agent.training_step(make_batch(0), 0) == BATCH
    assert logged == {"train/of": 7}


def test_after_a_fit_a_module_has_its_own_losses_again(agent):
    agent.recorded = lambda _: None

    CudaGraph().teardown(None, agent, "fit")

    assert agent.recorded is None


class NoStream:
    def wait_stream(self, other):
        pass


class NoGraph:
    def replay(self):
        pass


@pytest.fixture
def without_device(monkeypatch):
    """Let a recording run on a CPU: what it computes while it records is what it plays back."""

    @contextmanager
    def recorded(graph):
        torch.manual_seed(1)
        yield

    for name, stand_in in {
        "Stream": NoStream,
        "CUDAGraph": NoGraph,
        "current_stream": NoStream,
        "stream": lambda _: nullcontext(),
        "graph": recorded,
    }.items():
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(forbes.performance.fusion, "_compiled", lambda function: function)
    yield
    cuda_graph._streams.cache_clear()


@pytest.mark.usefixtures("without_device")
def test_the_branches_of_a_recording_add_up_to_the_whole(agent):
    recorded = Recording(agent, make_batch(0), nullcontext)

    torch.testing.assert_close(results(recorded, agent, make_batch(0)), results(agent.total_loss, agent, make_batch(0)))


@pytest.mark.usefixtures("without_device")
def test_a_recording_changes_no_state_of_dreamerv3s_parts():
    """The slow critic does not learn, and the range of the returns counts updates, not their preparation."""
    torch.manual_seed(0)
    arguments = {"observation_shape": (3, 28, 28), "action_dim": 2, "state_dim": 4, "hidden_dim": 6, "mlp_dim": 8}
    agent = ImaginationActorCritic(
        belief=GaussianBelief, horizon=3, control_dim=8, two_hot=True, scale_returns=True, slow_critic=0.5, **arguments
    )
    torch.nn.init.normal_(agent.critic.net[1].weight)  # an untrained critic gives 0, and all returns are equal
    before = {name: values.clone() for name, values in agent.state_dict().items()}

    recorded = Recording(agent, make_batch(0), nullcontext)

    after = agent.state_dict()
    assert all(torch.equal(values, after[name]) for name, values in before.items())
    agent.return_scale(torch.ones(2, 3), torch.ones(2, dtype=torch.bool))
    assert agent.return_scale.percentiles.min() > 0  # an update does move it
    assert recorded(make_batch(0)).loss.isfinite()


@pytest.mark.usefixtures("without_device")
def test_a_scaled_loss_has_scaled_gradients(agent):
    recorded = Recording(agent, make_batch(0), nullcontext)
    _, _, once = results(recorded, agent, make_batch(0))
    _, _, thrice = results(lambda batch: (3 * recorded(batch).loss, {}), agent, make_batch(0))

    torch.testing.assert_close(thrice, tuple(3 * gradient for gradient in once))


@pytest.mark.usefixtures("without_device")
def test_an_update_that_cannot_be_recorded_is_one_sentence(agent, monkeypatch):
    @contextmanager
    def refuse(graph):
        raise RuntimeError("CUDA error: operation not permitted when stream is capturing\nmore of it")
        yield

    monkeypatch.setattr(torch.cuda, "graph", refuse)

    with pytest.raises(ForbesError, match=r"CudaGraph: the update of ImaginationActorCritic cannot be recorded \(CUDA"):
        Recording(agent, make_batch(0), nullcontext)


@on_gpu
@pytest.mark.parametrize("half", [False, True], ids=["float32", "bf16"])
def test_a_recording_gives_the_losses_and_gradients_of_any_batch(agent, half):
    agent.cuda()
    batches = [SequenceBatch(*(values.cuda() for values in make_batch(seed))) for seed in range(3)]

    def precision():
        return torch.autocast("cuda", torch.bfloat16, cache_enabled=False) if half else nullcontext()

    def plain(batch):
        with precision():
            return agent.total_loss(batch)

    recorded = Recording(agent, batches[0], precision)
    tolerance = {"rtol": 2e-2, "atol": 2e-2} if half else {"rtol": 1e-4, "atol": 1e-5}
    for batch in batches:
        torch.testing.assert_close(results(recorded, agent, batch), results(plain, agent, batch), **tolerance)


@on_gpu
def test_a_training_goes_as_it_would_without(tmp_path):
    plain, recorded = trained(tmp_path, "without", OVERLAP), trained(tmp_path, "with", WITH, OVERLAP)

    assert [row.keys() for row in recorded] == [row.keys() for row in plain]
    for ours, theirs in zip(recorded, plain, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-3, abs=1e-3)
