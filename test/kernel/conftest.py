"""The fixtures of every test with a port or a link of real time."""
import pytest
from link_fixtures import (every_thread_ends, line, lines, logger, port, running,  # noqa: F401
                           this_machine_stalls_no_link, time_limit)

from serial_communication.transport.port import Port, PortError


@pytest.fixture(name='refusal')
def error_of_opening():
    """A function that returns the error of opening a port."""
    def refusal(url):
        refused = Port(url)
        with pytest.raises(PortError) as error:
            refused.open()
        assert not refused.is_open
        return str(error.value)
    return refusal
