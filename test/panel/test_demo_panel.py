"""scripts/demo --panel --control: the page of a demo, at the address that it prints."""
import contextlib
import os
import re
import signal
import stat
import subprocess
from pathlib import Path

from boards import PATIENCE, Output, again_if_stalled, until
from panel_helpers import Page, free_port, post

CHECKOUT = Path(__file__).resolve().parents[2]


def run(output):
    return subprocess.Popen(
        [str(CHECKOUT / 'scripts' / 'demo'), '--panel', '--control'], stdin=subprocess.DEVNULL,
        stdout=output, stderr=output, start_new_session=True,
        env={**os.environ, 'ROS_MASTER_URI': f'http://localhost:{free_port()}'})


class PrintedPanel:
    """A panel that another program has started, by the address that it printed."""

    def __init__(self, address):
        self.port, self.token = int(address.group(1)), address.group(2)

    def exchange(self, token):
        """Send the token."""
        return post(self.port, '/key', token.encode())


def test_the_demo_prints_the_address_of_a_page_that_has_commands():
    with contextlib.closing(Output()) as output:
        demo = run(output)

        def shown(pattern):
            return re.search(pattern, output.text())
        try:
            # Each begins with programs that start one after the other.
            until(lambda: shown('Launching the bridge') or demo.poll() is not None, 'it launches')
            address = until(lambda: shown(r'In a browser:  http://127.0.0.1:(\d+)/#(\S+)')
                            or demo.poll() is not None, 'it is printed')
            panel = PrintedPanel(address)
            page = Page(panel, panel.token).settle()
            page.until(lambda page: any(
                update.get('links', {}).get('bus', {}).get('level') == 0
                for update in list(page.updates)), 'the bus is ready')
            again_if_stalled(
                lambda: page.call('~lift', direction=0, distance=5)['outcome'] == 'done')
            page.close()
            # Nothing else moves the robot, and nobody else can read the token.
            until(lambda: shown('none; the page has them'), 'the table is shown')
            log = CHECKOUT / 'build' / 'ros' / 'log' / f'demo_{demo.pid}.log'
            assert stat.S_IMODE(log.stat().st_mode) == 0o600
        finally:
            demo.send_signal(signal.SIGINT)
            demo.wait(PATIENCE)
