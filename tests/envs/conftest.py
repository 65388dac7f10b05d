"""The backend that renders here, asked for once."""

import pytest

from forbes.envs.rendering import choose_backend
from forbes.errors import ForbesError


@pytest.fixture(scope="session")
def backend():
    """Its name; without one, what needs pixels is skipped."""
    try:
        return choose_backend().backend
    except ForbesError as error:
        pytest.skip(str(error))
