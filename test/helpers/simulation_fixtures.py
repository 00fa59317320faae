"""The fixture for tests of simulated boards on a real tty."""
import pytest
from lines import Line


@pytest.fixture
def cable(tmp_path):
    one = Line(tmp_path / 'near' / 'ttyA', tmp_path / 'far' / 'ttyB').plug()
    yield one
    one.unplug()
