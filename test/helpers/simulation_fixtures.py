"""The fixture for tests of simulated boards on a real tty."""
import pytest
from simulation_bench import Cable


@pytest.fixture
def cable(tmp_path):
    one = Cable(tmp_path)
    one.plug()
    yield one
    one.unplug()
