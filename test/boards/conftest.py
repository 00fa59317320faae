"""The fixtures of every test with a link or a port."""
from link_fixtures import (every_thread_ends, line, lines, logger, port, running,  # noqa: F401
                           this_machine_stalls_no_link, time_limit)
