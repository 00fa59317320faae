"""The fixtures of every test with a link or a port."""
import pytest
from fake_boards import until
from link_fixtures import (every_thread_ends, line, lines, logger, port, running,  # noqa: F401
                           this_machine_stalls_no_link, time_limit)

from serial_communication.boards.mcu.link import McuLink
from serial_communication.transport.port import Port


@pytest.fixture
def open_link(line, logger, running):     # noqa: F811
    """A function that starts a link at `line`, and returns it when its port is open."""
    def start(kind, *arguments, port=Port, **more):     # noqa: F811
        link = running(kind(port(line.path), *arguments, logger=logger, **more))
        until(lambda: link.connection.number)
        return link
    return start


@pytest.fixture
def sensor(open_link):
    """A link to the sensor board that never counts as silent; `got` has the SEQs it passed on."""
    got = []
    link = open_link(McuLink, timeout=60.0,
                     on_status=lambda message, seq, stamp: got.append(seq))
    link.got = got
    return link
