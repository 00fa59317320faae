"""Nothing on the page moves under a pointer, whatever boards and bridge do; in a browser."""
import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time

import pytest
from boards import Bridge, Line, program, until
from panel_helpers import TOKEN, Panel

if not shutil.which('chromedriver'):
    pytest.skip('no browser: Ubuntu has chromium only as a snap, which no driver can start',
                allow_module_level=True)

from panel_browser import Browser, read_script  # noqa: E402

SECONDS = 60.0
DESKTOP, PHONE = (1600, 1000), (390, 844)
TABS = 'Commands', 'Drive', 'Links'


@pytest.fixture(scope='module')
def shaky(core):
    """A panel with commands for a bridge whose boards have every fault there is."""
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix='shaky_'))
        lines = {name: Line(os.path.join(folder, name)).plug()
                 for name in ('bus', 'arduino', 'mcu')}
        for seed, (name, line) in enumerate(lines.items()):
            stack.callback(line.unplug)
            board = subprocess.Popen([program('simulator'), name, '--port', line.far, '--seed',
                                      str(seed), '--faults', 'all'], stdout=subprocess.DEVNULL,
                                     stderr=subprocess.DEVNULL)
            stack.callback(board.wait)
            stack.callback(board.terminate)
        bridge = Bridge('shaky', {f'{name}/port': line.near for name, line in lines.items()})
        stack.callback(bridge.end)
        panel = Panel('--control', '--token', TOKEN, '--node', '/shaky', name='panel_shaky')
        stack.callback(panel.end)
        yield panel, bridge


@pytest.fixture(scope='module')
def browsers(shaky):
    """The page on a desktop and on a phone."""
    panel, _bridge = shaky
    found = [Browser(*DESKTOP), Browser(*PHONE)]
    for browser in found:
        browser.open(panel.url)
        browser.wait_for_text('#connection', 'live')
        browser.wait(lambda page: len(page.all('.link:not([data-health="none"])')) == 3,
                     'every link has a status')
        browser.wait(lambda page: page.script(
            "return [...document.querySelectorAll('[data-service]')].length") > 3, 'its controls')
    yield found
    for browser in found:
        browser.quit()


def show(browser, tab):
    """Show this tab."""
    browser.script("[...document.querySelectorAll('.tabs button')]"
                   ".find(b => b.textContent == arguments[0]).click()", tab)


@pytest.mark.slow
def test_no_other_control_comes_under_the_pointer(shaky, browsers):
    _panel, bridge = shaky
    desktop, phone = browsers
    moved, samples, healths = [], 0, set()
    desktop.script(read_script('watch_points'))
    for tab in TABS:
        show(phone, tab)
        phone.wait_for_updates(5)
        phone.script(read_script('watch_points'))
        end = time.monotonic() + SECONDS / len(TABS)
        # The bridge reports nothing for a while, which the page shows at its top.
        if tab == TABS[1]:
            bridge.process.send_signal(signal.SIGSTOP)
            try:
                for browser in browsers:
                    browser.wait(lambda page: 'has reported nothing' in page.text('#trouble')
                                 and 'none' in page.script('return [...healths]'),
                                 'the trouble is shown, and noted')
            finally:
                bridge.process.send_signal(signal.SIGCONT)
        until(lambda end=end: time.monotonic() > end, 'the time has passed', SECONDS)
        moved += [f'phone, {tab}: {each}' for each in phone.script('return moved')]
        samples += phone.script('return samples')
        healths |= set(phone.script('return [...healths]'))
    moved += [f'desktop: {each}' for each in desktop.script('return moved')]
    samples += desktop.script('return samples')
    healths |= set(desktop.script('return [...healths]'))
    print(f'{len(moved)} of {20 * samples}: another control')
    assert {'warn', 'none'} <= healths, 'neither faults nor the silence were shown'
    assert samples > 100
    assert len(moved) == 0, (20 * samples, sorted(set(moved)))
