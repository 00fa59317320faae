"""scripts/demo --panel: the page of a demo, at the address that it prints."""
import os
import re
import signal
import subprocess
import tempfile
import urllib.request
from pathlib import Path

from boards import until
from panel_helpers import free_port

DEMO = Path(__file__).resolve().parents[2] / 'scripts' / 'demo'


def run(output):
    return subprocess.Popen(
        [str(DEMO), '--panel'], stdin=subprocess.DEVNULL, stdout=output, stderr=output,
        start_new_session=True,
        env={**os.environ, 'ROS_MASTER_URI': f'http://localhost:{free_port()}'})


def test_the_demo_prints_the_address_of_its_page():
    with tempfile.TemporaryFile('w+') as output:
        demo = run(output)
        try:
            def address():
                output.seek(0)
                return re.search(r'In a browser:  (http://127.0.0.1:\d+/)', output.read())
            found = until(lambda: address() or demo.poll() is not None, 'it is printed', 60)
            with urllib.request.urlopen(found.group(1), timeout=15) as page:
                assert '<title>panel</title>' in page.read().decode()
        finally:
            demo.send_signal(signal.SIGINT)
            demo.wait(20)
