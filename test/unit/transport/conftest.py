"""A line for the test of names."""
import pytest

from lines import Pty


@pytest.fixture
def line(tmp_path):
    """A real tty."""
    made = Pty(tmp_path / 'port').plug()
    yield made
    made.unplug()
