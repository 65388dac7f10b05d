"""The names of `import forbes`, for type checkers; `tests/test_python_api.py` keeps both files alike."""

from forbes.beliefs import (
    CategoricalBelief as CategoricalBelief,
    FlowBelief as FlowBelief,
    GaussianBelief as GaussianBelief,
    MixtureBelief as MixtureBelief,
)
from forbes.data import (
    Episode as Episode,
    EpisodeWriter as EpisodeWriter,
    Experience as Experience,
    Replay as Replay,
    SequenceBatch as SequenceBatch,
    SequenceDataModule as SequenceDataModule,
    Simulated as Simulated,
    Strokes as Strokes,
)
from forbes.envs import DeepMindControl as DeepMindControl, Gymnasium as Gymnasium, find_environment as find_environment
from forbes.errors import ForbesError as ForbesError
from forbes.evaluation import (
    ELBO as ELBO,
    PLL as PLL,
    CalibrationError as CalibrationError,
    complete as complete,
    evaluate as evaluate,
    filter as filter,
    imagine as imagine,
)
from forbes.models import (
    Bernoulli as Bernoulli,
    ConvDecoder as ConvDecoder,
    ConvEncoder as ConvEncoder,
    MLPDecoder as MLPDecoder,
    MLPEncoder as MLPEncoder,
    ModelAdapter as ModelAdapter,
    ModelParts as ModelParts,
    Normal as Normal,
    OneHot as OneHot,
    OnePixel as OnePixel,
    ParticleModel as ParticleModel,
    PartsDecoder as PartsDecoder,
    PartsEncoder as PartsEncoder,
    PartsLikelihood as PartsLikelihood,
    PixelDecoder as PixelDecoder,
    PixelEncoder as PixelEncoder,
    State as State,
    StateSpaceModel as StateSpaceModel,
    SymlogNormal as SymlogNormal,
    VectorModel as VectorModel,
    VectorNormal as VectorNormal,
)
from forbes.pomdps import (
    LightDark as LightDark,
    LinearGaussian as LinearGaussian,
    MirrorSensor as MirrorSensor,
    MountainHike as MountainHike,
    TMaze as TMaze,
    Tiger as Tiger,
    Ungm as Ungm,
)
from forbes.training import (
    ImaginationActorCritic as ImaginationActorCritic,
    KnownBelief as KnownBelief,
    PlanningAgent as PlanningAgent,
    WorldModel as WorldModel,
)
from forbes.training.loading import load_run as load_run

__version__: str
MODULES: dict[str, str]
