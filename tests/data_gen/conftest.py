"""The simulator for the tests that need it, or the reason why they are skipped."""

import pytest

from wbgs_jax._util.errors import UserError


@pytest.fixture(scope="session")
def simulator_backend() -> str:
    """Chooses the backend once; skips where sionna-rt or libLLVM is missing."""
    from data_gen.llvm import ensure_backend

    try:
        return ensure_backend()
    except UserError as error:
        pytest.skip(str(error))
