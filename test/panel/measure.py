"""Measures the time from a topic to the page, the load of a panel, and the time until the car stops
when a page that drives fails; run by hand:

    . build/devel/setup.bash; python3 test/panel/measure.py [SECONDS]

Starts a master, the simulated boards with their bridge, a panel and a browser. Time: this process
publishes numbers at random times, and the page records when its text changes, by the same clock.
Load: of the panel's process, at the usual rates of the boards, without a page, with one page, and
with the wire open. Stop: from what happens to the browser, the network or the panel until the board
receives SPEED 0.
"""
import math
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / 'ros'), str(Path(__file__).parent)]

import panel_helpers  # noqa: E402
import rospy  # noqa: E402
from boards import until  # noqa: E402
from panel_browser import Browser  # noqa: E402
from std_msgs.msg import Float32  # noqa: E402
from test_browser import hold  # noqa: E402

from serial_communication.boards.arduino import wire as arduino  # noqa: E402

TRIES = 5       # of each way in which a page that drives fails

_WATCH = '''
    window.seen = {};
    const place = document.querySelector('[data-reading="~probe:data"] .number');
    new MutationObserver(() => { seen[place.textContent] = Date.now(); }).observe(
        place, {childList: true, characterData: true, subtree: true});
'''


def cpu(process, seconds):
    """The load of a process in percent of a core."""
    def used():
        fields = Path(f'/proc/{process.pid}/stat').read_text().rsplit(')', 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
    began, before = time.monotonic(), used()
    time.sleep(seconds)
    return 100 * (used() - before) / (time.monotonic() - began)


def latencies(browser, number):
    """The times in ms from before publishing to the text on the page, and how many were sent."""
    probe = rospy.Publisher('~probe', Float32, queue_size=1, tcp_nodelay=True)
    panel = panel_helpers.Panel('--node', rospy.get_name(), name='panel_measured')
    browser.open(panel.url)
    until(lambda: browser.all('[data-reading="~probe:data"]'), 'the topic is on the page',
          doing=lambda: probe.publish(-1.0), every=0.2)
    browser.script(_WATCH)
    sent = {}
    for count in range(1, number + 1):
        time.sleep(random.uniform(0.05, 0.2))
        sent[str(count)] = time.time() * 1e3
        probe.publish(float(count))
    browser.wait(lambda page: str(number) in page.script('return seen'), 'the last number is shown')
    seen = browser.script('return seen')
    panel.end()
    return sorted(seen[each] - sent[each] for each in sent if each in seen), number


# Contexts in which a page that drives fails.
FAILURES = {
    'its tab is hidden': lambda browser, _network, _panel: browser.other_tab(),
    'its connection is cut': lambda _browser, network, _panel: network.cut(),
    'the network delivers nothing': lambda _browser, network, _panel: network.delayed(),
    'the browser is suspended': lambda browser, _network, _panel: browser.frozen(),
    'the browser is killed': lambda browser, _network, _panel: browser.killed(),
    'the panel is suspended':
        lambda _browser, _network, panel: panel_helpers.suspended(panel.process.pid)}


def time_until_stop(failure, robot, panel):
    """The time in ms from this failure of a page that drives until the board received SPEED 0.

    None if the car had stopped before, because this machine stalled.
    """
    network = panel_helpers.Network(panel)
    browser = Browser()
    try:
        browser.open(network.url)
        browser.wait_for_text('#connection', 'live')
        browser.wait_for_text('[data-link="bus"] .summary', 'ready')
        robot.car.forget()
        hold(browser, robot)
        began = time.monotonic()
        with failure(browser, network, panel) as known:
            began = known or began
            until(lambda: robot.car.speeds[-1] == 0, 'the car stops')
        return next((1e3 * (frame.stamp - began) for frame in robot.car.command_frames
                     if frame.stamp > began and isinstance(frame.message, arduino.SpeedCommand)
                     and frame.message.value == 0), None)
    finally:
        browser.quit()
        network.end()


def print_times_until_stop():
    """Print the times until SPEED 0 for each failure."""
    with tempfile.TemporaryDirectory() as folder:
        robot = panel_helpers.Robot(folder)
        panel = panel_helpers.Panel('--control', '--token', panel_helpers.TOKEN)
        for name, failure in FAILURES.items():
            tries = [time_until_stop(failure, robot, panel) for _ in range(TRIES)]
            times = sorted(each for each in tries if each is not None) or [math.nan]
            print(f'SPEED 0 after {name:28} p50 {statistics.median(times):.0f}, '
                  f'most {times[-1]:.0f} ms, of {len(times)}', flush=True)
        panel.end()
        robot.end()


def main():
    """Measure and print."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    os.environ['ROS_MASTER_URI'] = f'http://localhost:{panel_helpers.free_port()}'
    os.environ.setdefault('ROS_HOSTNAME', 'localhost')
    core = panel_helpers.Core()
    rospy.init_node('measure', disable_signals=True)
    with tempfile.TemporaryDirectory() as folder:
        launch = subprocess.Popen(
            ['roslaunch', 'serial_communication', 'bridge.launch', 'sim:=true',
             'sim_dir:=' + folder], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        rospy.wait_for_service(panel_helpers.NODE + '/calibrate_imu', 30)
        panel = panel_helpers.Panel()
        time.sleep(5)
        print(f'load average {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores')
        print(f'panel, no page          {cpu(panel.process, seconds):5.1f} % of a core')
        browser = Browser()
        browser.open(panel.url)
        browser.wait_for_text('#connection', 'live')
        time.sleep(5)
        print(f'panel, one page         {cpu(panel.process, seconds):5.1f} % of a core')
        browser.click('#card-wire > summary')
        time.sleep(2)
        print(f'panel, the wire as well {cpu(panel.process, seconds):5.1f} % of a core')
        panel.end()
        found, number = latencies(browser, 200)
        print(f'from topic to page, {len(found)} of {number}: p50 {statistics.median(found):.0f}, '
              f'p90 {found[int(len(found) * 0.9)]:.0f}, most {found[-1]:.0f} ms')
        browser.quit()
        launch.terminate()
        launch.wait(20)
    print_times_until_stop()
    rospy.signal_shutdown('done')
    core.stop()


if __name__ == '__main__':
    main()
