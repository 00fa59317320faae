"""The fixtures of every test with a port or a link of real time."""
from link_fixtures import (every_thread_ends, line, logger, port, running,  # noqa: F401
                           this_machine_stalls_no_link, time_limit)
