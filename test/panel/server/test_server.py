"""The panel, tested with clients without a browser: access, limits, subscriptions and commands."""
import contextlib
import json
import os
import pty
import re
import resource
import signal
import socket
import subprocess
import threading
import time
import types
from itertools import count, islice

import pytest
import qrcode
import rosgraph
import rospy
from boards import PATIENCE, program, ranges, until
from panel_helpers import (GRIPPER, NODE, TOKEN, Page, Panel, free_port, publishers_and_subscribers,
                           subscribed)

from std_msgs.msg import String

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.msg import SerialMsg, SpeedPWMCommand

TOPICS = ['~imu', '~voltage', '~environment', 'mcu/range_1', '~nothing']


@pytest.fixture
def page(panel):
    page = Page(panel, watch=TOPICS)
    yield page
    page.close()


@pytest.fixture(scope='module')
def two_pages(panel):
    """A page that acknowledges nothing, and one that does.

    The first is dropped after 5 s, during which other tests run.
    """
    slow, other = Page(panel, acknowledges=False), Page(panel)
    yield slow, other
    other.close()


@pytest.fixture
def driver(control_panel, robot):
    """A page that may drive, and whose commands the bridge receives."""
    page = Page(control_panel, TOKEN).settle()
    until(lambda: robot.car.connected, 'the car is connected')
    until(lambda: control_panel.node in publishers_and_subscribers()[0].get(NODE + '/speed', ()),
          'the panel publishes speeds')
    robot.car.forget()
    yield page
    page.close()
    until(lambda: not page.known.get('drive', {}).get('held') or page.closed, 'no page drives')


# -- the command line -------------------------------------------------------------------------


def run(*arguments, environment=None):
    return subprocess.run([program('panel'), *arguments], text=True, timeout=60,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          env={**os.environ, 'ROS_MASTER_URI': 'http://127.0.0.1:1',
                               **(environment or {})})


def test_help_names_every_option():
    done = run('--help')
    assert done.returncode == 0 and done.stdout.startswith('usage: panel') and not done.stderr
    for word in ('--port', '--bind', '--control', '--token', '--node'):
        assert word in done.stdout


@pytest.mark.parametrize('arguments, words', [
    (['--port', '99999'], "'99999' is not a port (0 … 65535)"),
    (['--port', 'x'], "'x' is not a port"), (['--fast'], 'unrecognized arguments: --fast'),
    (['--token', 'short'], 'invalid token of 5 characters: it must have 12 … 200 of A-Z'),
    (['--token', 'with a space in it'], 'invalid token of 18 characters')])
def test_a_wrong_argument_ends_with_status_2_and_a_message(arguments, words):
    done = run(*arguments)
    assert done.returncode == 2 and words in done.stderr and not done.stdout


@pytest.fixture
def no_tornado(tmp_path):
    """The environment of a machine without tornado."""
    (tmp_path / 'tornado.py').write_text(
        "raise ModuleNotFoundError('No module named tornado', name='tornado')")
    return {'PYTHONPATH': f'{tmp_path}:{os.environ["PYTHONPATH"]}'}


def test_without_tornado_one_line_names_the_package_and_help_works(no_tornado):
    done = run(environment=no_tornado)
    assert (done.returncode, done.stdout, done.stderr) == (
        1, '', 'panel: the page needs tornado; install it: sudo apt-get install python3-tornado\n')
    assert run('--help', environment=no_tornado).stdout.startswith('usage: panel')


@pytest.mark.usefixtures('two_pages')       # so that their 5 s begin
def test_a_port_in_use_ends_with_one_line_that_names_its_holder_and_a_free_port(panel):
    done = run('--port', str(panel.port))
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1
    found = re.fullmatch(r'panel: cannot listen on 127.0.0.1 port (\d+): Address already in use, '
                         r'by panel \(pid (\d+)\); free: --port (\d+)\n', done.stderr)
    assert found.group(1, 2) == (str(panel.port), str(panel.process.pid))
    assert int(found.group(3)) > panel.port


def test_a_second_panel_without_options_takes_the_next_port_and_name(robot):
    one = Panel(port=None, name=None)
    until(lambda: is_registered('/panel'), 'it is registered')
    other = Panel(port=None, name=None)
    assert other.port > one.port >= 8080
    other.wait_for(f'port 8080 is taken by panel (pid {one.process.pid}); the next')
    until(lambda: is_registered('/panel_2'), 'it is registered under another name')
    for panel in one, other:
        page = Page(panel, watch=TOPICS)
        page.until(lambda page: '~imu' in page.samples, 'it shows the bridge')
        page.close()
        assert panel.end() == 0


def test_panels_that_start_together_take_different_names(core):
    panels = []
    threads = [threading.Thread(target=lambda: panels.append(Panel(name=None))) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(panels) == 5
    names = ['/panel', *(f'/panel_{number}' for number in range(2, 6))]
    until(lambda: all(is_registered(name) for name in names)
          or not all(panel.alive for panel in panels), 'all are registered')
    assert [panel.end() for panel in panels] == [0] * 5


def test_on_a_terminal_an_address_for_the_network_is_a_qr_code_as_well():
    """Tells dark from light as a camera does, on a terminal with a dark background."""
    near, far = pty.openpty()
    panel = subprocess.Popen([program('panel'), '--port', '0', '--bind', '0.0.0.0',
                              '__name:=panel_qr'], stdin=far, stdout=far, stderr=far,
                             env={**os.environ, 'ROS_MASTER_URI': 'http://127.0.0.1:1'})
    os.close(far)
    shown = bytearray()
    try:
        def is_complete():
            shown.extend(os.read(near, 65536))
            return b'waiting for the ROS master' in shown
        until(is_complete, 'it prints')
        text = shown.decode().replace('\r', '').split('panel: waiting')[0]
        address, _, code = text.partition('\n')
        url = re.fullmatch(r'panel: (http://[^/:]+:\d+/#\S+)', address).group(1)
        rows = [[cell in dark for cell in line] for line in code.rstrip('\n').split('\n')
                for dark in (' \N{NO-BREAK SPACE}\N{LOWER HALF BLOCK}',
                             ' \N{NO-BREAK SPACE}\N{UPPER HALF BLOCK}')]
        wanted = qrcode.QRCode(border=2)
        wanted.add_data(url)
        assert rows[:len(wanted.get_matrix())] == wanted.get_matrix()
    finally:
        panel.terminate()
        panel.wait(PATIENCE)
        os.close(near)


def test_without_a_master_the_panel_serves_pages_that_say_so():
    panel = Panel(environment={'ROS_MASTER_URI': 'http://127.0.0.1:1'})
    panel.wait_for('panel: waiting for the ROS master at http://127.0.0.1:1; start one with')
    page = Page(panel)
    page.until(lambda page: 'no answer from the ROS master' in page.known.get('trouble', ''),
               'the page shows it')
    page.close()
    assert panel.end(signal.SIGINT) == 0
    assert 'Traceback' not in panel.output()


_NAME_TAKEN = '''
import sys, rospy
from serial_communication.tools.panel import cli
begin = rospy.init_node
def init_node(*arguments, **keywords):
    %s
rospy.init_node = init_node
sys.exit(cli.main(['--port', '0']))
'''


@pytest.mark.usefixtures('robot')
@pytest.mark.parametrize('meanwhile', [
    "raise rospy.ROSInitException('init_node interrupted before it could complete')",
    'begin(*arguments, **keywords); rospy.core._in_shutdown = True'    # its hooks have run
], ids=['before', 'after'])
def test_a_name_taken_during_registration_ends_the_panel(meanwhile):
    done = subprocess.run(['/usr/bin/python3', '-c', _NAME_TAKEN % meanwhile], text=True,
                          timeout=30, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert done.returncode == 1, done.stderr
    assert done.stderr.count('ROS has ended this node') == 1 and 'Traceback' not in done.stderr


def test_a_second_panel_of_the_same_name_ends_and_the_first_continues(panel):
    second = Panel(name='panel_read_only')
    assert second.process.wait(30) == 3
    second.wait_for('another node is named /panel_read_only')
    second.wait_for('or name this one: __name:=panel_read_only_2')
    assert 'Traceback' not in second.output()
    page = Page(panel, watch=TOPICS)
    page.until(lambda page: '~imu' in page.samples, 'the first continues')
    page.close()


def test_a_name_taken_later_ends_the_panel(robot):
    panel = Panel(name='panel_taken')
    until(lambda: is_registered('/panel_taken'), 'it is registered')
    rosgraph.Master('/panel_taken').registerSubscriber(
        '/chatter', 'std_msgs/String', 'http://localhost:1/')
    assert panel.process.wait(30) == 1
    panel.wait_for('panel: ROS has ended this node')


def is_registered(name):
    try:
        return rosgraph.Master('/panel_test').lookupNode(name)
    except rosgraph.MasterError:
        return False


# -- access -----------------------------------------------------------------------------------


def test_the_policy_forbids_foreign_and_inline_content(panel):
    status, headers, text = panel.get('/')
    assert status == 200 and '<title>' in text
    policy = headers['Content-Security-Policy']
    for rule in ("default-src 'none'", "script-src 'self'", "frame-ancestors 'none'",
                 "base-uri 'none'", "require-trusted-types-for 'script'"):
        assert rule in policy
    assert 'unsafe' not in policy and '*' not in policy
    assert headers['X-Content-Type-Options'] == 'nosniff'
    assert headers['Referrer-Policy'] == 'no-referrer'
    for feature in 'camera', 'microphone', 'serial', 'usb', 'geolocation':
        assert f'{feature}=()' in headers['Permissions-Policy']


@pytest.mark.parametrize('path', ['/../cli.py', '/%2e%2e/cli.py', '/cards/../../cli.py',
                                  '/nothing.js', '/cards/'])
def test_files_outside_the_web_folder_are_not_served(panel, path):
    assert panel.get(path)[0] in (403, 404)


def test_a_foreign_host_is_refused(panel):
    status, _headers, text = panel.get('/', Host='evil.example')
    assert status == 403 and 'is not a name of this machine' in text
    assert Page(panel, host='evil.example:80').status == 403
    panel.wait_for('is not a name of this machine')


@pytest.mark.parametrize('origin', ['http://evil.example', 'null', None])
def test_a_connection_with_a_foreign_or_missing_origin_is_refused(panel, origin):
    assert Page(panel, origin=origin).status == 403


def test_a_file_is_refused_to_a_foreign_origin_only(panel):
    assert panel.get('/app.js', Origin='http://evil.example')[0] == 403
    assert panel.get('/app.js', Origin=f'http://127.0.0.1:{panel.port}')[0] == 200


def test_a_connection_needs_the_key_that_the_token_is_exchanged_for(control_panel):
    assert control_panel.url.endswith(f'/#{TOKEN}')
    status, headers, _text = control_panel.get('/')
    assert status == 200 and 'Set-Cookie' not in headers       # the files are the same everywhere
    assert Page(control_panel).status == 401
    assert control_panel.get('/key')[0] == 401
    status, headers, key = control_panel.exchange(TOKEN)
    assert status == 200 and 'Set-Cookie' not in headers and TOKEN not in key
    assert headers['Cache-Control'] == 'no-store'
    assert control_panel.get('/key', X_Key=key)[0] == 200
    page = Page(control_panel, TOKEN)
    assert page.status == 101
    page.close()
    # Printed once, in the address, and never logged.
    assert control_panel.output().count(TOKEN) == 1


@pytest.mark.parametrize('origin', ['http://evil.example', 'null', ''])
def test_a_page_of_another_site_cannot_send_a_token(control_panel, origin):
    assert control_panel.exchange(TOKEN, Origin=origin)[0] == 403


def test_a_wrong_token_is_refused_and_the_right_one_gets_in_nevertheless():
    panel = Panel('--control', name='panel_guessed')
    ended = threading.Event()

    def guess():
        while not ended.is_set():
            assert panel.exchange('not-the-right-one')[0] == 401
    guesser = threading.Thread(target=guess)
    guesser.start()
    try:
        status, _headers, text = panel.exchange('not-the-right-one')
        assert status == 401 and 'the token is wrong' in text
        token = panel.token
        for number in range(1, 11):
            assert panel.exchange(token)[0] == 200
            addresses = until(lambda number=number: printed(panel, number + 1), 'a new address')
            assert panel.exchange(token)[0] == 401
            token = addresses[-1].partition('#')[2]
    finally:
        ended.set()
        guesser.join()
    assert len(addresses) == len(set(addresses))
    assert 'panel: for another browser: http://127.0.0.1:' in panel.output()
    assert panel.end() == 0


def printed(panel, number):
    """The addresses that the panel has printed, if there are so many."""
    found = re.findall(r'http://\S+#\S+', panel.output())
    return found if len(found) >= number else None


def test_guesses_of_a_token_of_ones_own_are_limited_over_all_addresses():
    """Every address of loopback is another one."""
    panel = Panel('--control', '--token', TOKEN, name='panel_own_token')
    assert panel.exchange(TOKEN)[0] == 200
    answers = [guess_from(f'127.0.{number // 250}.{number % 250 + 1}', panel)
               for number in range(300)]
    assert 100 <= sum('the token is wrong' in each for each in answers) < 150
    assert 'one in 2 s is compared: try again' in answers[-1]
    until(lambda: panel.exchange(TOKEN)[0] == 200, 'the right one gets in', every=0.2)
    assert panel.end() == 0


def guess_from(address, panel):
    """Send a wrong token from this address; return the answer."""
    with socket.create_connection(('127.0.0.1', panel.port), PATIENCE,
                                  source_address=(address, 0)) as connection:
        connection.sendall(b'POST /key HTTP/1.0\r\nHost: localhost\r\nOrigin: http://localhost\r\n'
                           b'Content-Length: 5\r\n\r\nwrong')
        return connection.makefile().read()


def test_a_token_can_be_read_from_a_file(tmp_path):
    (tmp_path / 'token').write_text(TOKEN + '\n')
    panel = Panel('--control', '--token', f'@{tmp_path}/token', name='panel_file')
    assert panel.exchange(TOKEN)[0] == 200
    assert TOKEN.encode() not in open(f'/proc/{panel.process.pid}/cmdline', 'rb').read()
    assert panel.end() == 0


@pytest.mark.parametrize('arguments', [[], ['--control']])
def test_on_loopback_a_name_of_this_machine_is_refused(arguments):
    """A proxy or a tunnel that others reach is behind it."""
    panel = Panel(*arguments, name='panel_loopback')
    for host in socket.gethostname(), '192.168.1.7':
        status, _headers, text = panel.get('/', Host=f'{host}:{panel.port}')
        assert status == 403 and 'on loopback' in text
        assert Page(panel, host=f'{host}:{panel.port}').status == 403
    assert panel.get('/', Host='127.0.0.1')[0] == panel.get('/', Host='localhost')[0] == 200
    assert panel.end() == 0


@pytest.mark.parametrize('arguments', [['--control'], ['--bind', '0.0.0.0']])
def test_control_and_other_addresses_need_a_new_token(arguments):
    one, other = Panel(*arguments, name='one'), Panel(*arguments, name='other')
    assert len(one.token) >= 20 and one.token != other.token
    assert one.get('/key')[0] == Page(one).status == 401
    assert one.end() == other.end() == 0


def test_a_page_that_sends_too_often_or_invalid_messages_is_dropped(panel):
    for message in (b'{', b'[1]', b'{"watch": 5}', b'{"drive": 1}', b'{"seen": NaN}',
                    b'{"seen": 1e999}', b'{"release": {"hold": 1e999}}',
                    b'{"release": {"hold": -Infinity}}',
                    b'{"seen": 1%s, "led": {"text": ""}}' % (b'0' * 400), b'[' * 4000):
        page = Page(panel)
        page.write(message)
        until(lambda: 'sent an invalid message' in page.closed, f'{message} is refused')
    page = Page(panel)
    for _ in range(400):
        page.write(b'{"seen": 0}')
    until(lambda: 'more than 120 frames a second' in page.closed, 'it is dropped')
    page = Page(panel)
    page.write(json.dumps({'watch': ['x' * 5000]}).encode())
    until(lambda: page.closed, 'a message that is too long closes the connection')


@pytest.fixture
def other_page(panel):
    """A page that must continue whatever another one does."""
    page = Page(panel, watch=TOPICS)
    page.until(lambda page: '~imu' in page.samples, 'updates are received')
    yield page
    assert not page.closed
    seen = page.now
    page.until(lambda page: page.now > seen + 0.5, 'updates are received')
    page.close()


MASK = bytes(4)


@pytest.mark.parametrize('frame', [
    b'\x89\x80' + MASK, b'\x89\xfd' + MASK + bytes(125), b'\x8a\x80' + MASK, b'\x00\x80' + MASK],
    ids=['pings', 'long pings', 'pongs', 'fragments'])
@pytest.mark.parametrize('reads', [True, False])
def test_a_page_that_floods_with_other_frames_is_dropped(panel, other_page, frame, reads):
    page = Page(panel, reads=reads)
    if frame[0] == 0:
        page.send_raw(b'\x01\x80' + MASK)         # a message begins
    ended = threading.Event()

    def flood():
        while not ended.is_set():
            page.send_raw(frame * 1000)
    seen = other_page.now
    thread = threading.Thread(target=flood, daemon=True)
    thread.start()
    try:
        other_page.until(lambda page: page.now > seen + 1, 'others receive updates')
        if reads:
            until(lambda: page.closed, 'it is dropped')
            assert 'more than 120 frames' in page.closed or page.closed == 'gone'
    finally:
        ended.set()
        page.close()
        thread.join()


def test_a_ping_is_answered(page):
    page.write(b'x', 0x89)
    page.until(lambda page: page.pongs, 'the answer is received')


@pytest.mark.parametrize('message', [
    {}, {'seen': 1e18}], ids=['nothing', 'everything'])
def test_a_page_that_reads_nothing_is_dropped_whatever_it_acknowledges(robot, message):
    panel = Panel(name='panel_unread')
    page = Page(panel, watch=[*TOPICS, 'serial_msg'], reads=False)
    until(lambda: 'dropped a page at 127.0.0.1: it does not read' in panel.output(),
          'it is dropped', seconds=60,
          doing=lambda: message and page.send(**message), every=0.1)
    page.close()
    assert panel.end() == 0


def test_idle_connections_do_not_keep_other_pages_out(robot):
    panel = Panel(name='panel_crowded')
    before = Page(panel, watch=TOPICS)
    before.until(lambda page: '~imu' in page.samples, 'numbers are received')
    resource.prlimit(panel.process.pid, resource.RLIMIT_NOFILE, (160, 160))
    idle = [socket.create_connection(('127.0.0.1', panel.port)) for _ in range(300)]
    later = Page(panel, watch=TOPICS)
    later.until(lambda page: '~imu' in page.samples, 'another page is served')
    assert panel.get('/app.js')[0] == 200
    seen = before.now
    before.until(lambda page: page.now > seen + 0.5, 'the first receives updates')
    assert not before.closed
    for each in idle:
        each.close()
    assert panel.end() == 0
    assert 'Too many open files' not in panel.output()


def open_silent_page(panel, pages):
    pages.append(Page(panel, reads=False))
    return pages[-1].status == 101


def test_dropped_pages_that_stay_connected_do_not_keep_others_out(panel, other_page):
    pages = []
    for _ in range(80):
        until(lambda: open_silent_page(panel, pages), 'another page is accepted')
        pages[-1].write(b'{')
    later = Page(panel, watch=TOPICS)
    later.until(lambda page: '~imu' in page.samples, 'another page is served')
    for page in [*pages, later]:
        page.close()


def test_a_slow_page_is_dropped_and_the_others_are_not(panel, two_pages):
    slow, other = two_pages
    until(lambda: 'does not read' in slow.closed, 'the slow one is dropped')
    assert not other.closed
    panel.wait_for('it does not read what is sent to it')
    other.close()


def test_the_17th_page_is_refused(panel):
    pages = [Page(panel) for _ in range(16)]
    try:
        assert {page.status for page in pages} == {101}
        assert Page(panel).status == 503
    finally:
        for page in pages:
            page.close()
    until(lambda: open_and_close_page(panel), 'another page is accepted again')


def open_and_close_page(panel):
    page = Page(panel)
    page.close()
    return page.status == 101


# -- subscriptions and updates ----------------------------------------------------------------


def test_only_the_topics_that_pages_show_are_subscribed_to(panel):
    until(lambda: not subscribed(panel.node), 'nothing is subscribed to')
    page = Page(panel, watch=TOPICS)
    wanted = {NODE + '/imu', NODE + '/voltage', NODE + '/environment', '/mcu/range_1',
              '/diagnostics', '/rosout_agg'}
    until(lambda: subscribed(panel.node) == wanted, 'the topics of the page are subscribed to')
    page.send(watch=TOPICS + ['serial_msg'])
    until(lambda: subscribed(panel.node) == wanted | {'/serial_msg'}, 'the wire is subscribed to')
    page.until(lambda page: page.known.get('wire', {}).get('frames'), 'frames are received')
    page.send(watch=TOPICS)
    until(lambda: subscribed(panel.node) == wanted, 'the wire is not subscribed to any more')
    page.close()
    until(lambda: not subscribed(panel.node), 'nothing is subscribed to')


def test_pages_receive_values_and_links(page, robot):
    robot.others[0] = arduino.Voltage(6.25)
    page.until(lambda page: page.samples.get('~voltage', {}).get('voltage') == 6.25, 'the voltage')
    robot.others[0] = arduino.Voltage(7.4)
    page.until(lambda page: page.samples.get('~imu', {}).get('acceleration z') is not None,
               'the IMU')
    assert page.samples['~imu']['acceleration z'] == pytest.approx(9.81, abs=1e-3)
    page.until(lambda page: page.samples.get('~environment', {}).get('smoke') == 350, 'the air')
    page.until(lambda page: page.samples.get('mcu/range_1', {}).get('range') == 0.47, 'a range')
    page.until(lambda page: {'bus', 'arduino', 'mcu'} <= set(page.known.get('links', {})),
               'all links')
    assert page.known['links']['arduino']['values']['port'] == robot.lines['arduino'].near
    assert page.known['node'] == NODE and page.known['trouble'] == ''


def test_a_page_opened_later_receives_the_history(page, panel):
    page.until(lambda page: '~environment' in page.samples, 'the air')
    later = Page(panel, watch=TOPICS)
    later.until(lambda page: page.updates, 'the first update')
    first = later.updates[0]
    assert '~environment' in first['topics'] and 'smoke' in first['topics'][
        '~environment']['fields'][0]
    later.close()


def test_ranges_that_are_not_finite_are_valid_json(page, robot):
    for millimetres, word in ((65535, 'NaN'), (5000, 'Infinity'), (10, '-Infinity')):
        robot.ranges = ranges(millimetres)
        page.until(lambda page: page.samples.get('mcu/range_1', {}).get('range') == word,
                   f'{word} is received')
    robot.ranges = ranges()


_GAUGE = '''
from serial_communication.boards.description import Description, Heartbeat
from serial_communication.framing.parts import Part

class Decoder:
    def explain(self, frame):
        return [Part(0, len(frame), 'rain', frame, 7, 0.7, 'mm')]

def decoder(sent, parameters):
    if parameters['unit'] != 'mm':
        raise ValueError
    return Decoder()

DESCRIPTION = Description('gauge', __name__, decoder, 'rain gauge', heartbeat=Heartbeat(1, 0.5))
'''


def test_frames_of_a_board_of_another_package_are_explained(core, tmp_path):
    """This process simulates the bridge."""
    (tmp_path / 'rain_gauge').mkdir()
    (tmp_path / 'rain_gauge' / '__init__.py').write_text(_GAUGE)
    rospy.set_param('~boards', ['rain_gauge', 'not_installed'])
    rospy.set_param('~gauge', {'unit': 'mm'})
    traffic = rospy.Publisher('serial_msg', SerialMsg, queue_size=10)
    panel = Panel('--node', rospy.get_name(), name='panel_gauge',
                  environment={'PYTHONPATH': f'{tmp_path}:{os.environ["PYTHONPATH"]}'})
    try:
        page = Page(panel, watch=['serial_msg'])
        page.until(lambda page: 'gauge' in page.known.get('boards', {}), 'the board is known')
        assert page.known['boards']['gauge'] == {'title': 'rain gauge', 'longest_gap': 0.5}
        assert page.known['boards']['bus'] == {'title': 'control board', 'longest_gap': None}
        until(lambda: page.known.get('wire', {}).get('frames'), 'frames are received', every=0.1,
              doing=lambda: traffic.publish(link='gauge', frame=b'\1\2', text='rain'))
        assert page.known['wire']['frames'][0][6:] == ['0102', [['rain', 0, 2, '0.7 mm', '']]]
        page.close()
        assert panel.end() == 0
    finally:
        panel.end()
        traffic.unregister()
        rospy.delete_param('~boards')
        rospy.delete_param('~gauge')


# -- commands ---------------------------------------------------------------------------------


def test_a_read_only_panel_takes_no_commands(page, robot):
    before = len(robot.lift_requests)
    page.send(call={'key': 'a', 'name': '~lift', 'arguments': {'direction': 0, 'distance': 5}})
    page.until(lambda page: page.known.get('refused'), 'it is refused')
    assert 'read-only' in page.known['refused']['words'] and len(robot.lift_requests) == before
    assert 'controls' not in page.known
    assert not any('/panel_read_only' in publishers_and_subscribers()[0].get(NODE + name, ())
                   for name in ('/speed', '/steering', '/led'))


def lift(page, key, distance=5):
    page.send(call={'key': key, 'name': '~lift',
                    'arguments': {'direction': 0, 'distance': distance}})


def test_a_page_that_has_just_been_opened_takes_no_command_but_stop(control_panel, robot):
    robot.car.forget()
    robot.bus.forget()
    page = Page(control_panel, TOKEN)
    page.until(lambda page: 'node' in page.known, 'the panel sends updates')
    lift(page, 'early')
    page.send(led={'key': 'early led', 'text': 'left'})
    drive(page, 1)
    page.send(stop={'key': 'early stop'})
    refused = {}

    def collect(page):
        refused.update((update['refused']['key'], update['refused']['words'])
                       for update in list(page.updates) if 'refused' in update)
        return {'early', 'early led', 'drive'} <= set(refused)
    page.until(collect, 'all are refused')
    assert {each for key, each in refused.items() if key != 'early stop'} == {
        'nothing was sent: the page has just appeared; press again'}
    assert 'just appeared' not in refused.get('early stop', '')
    page.settle()
    assert not robot.lift_requests and not any(robot.car.speeds)
    page.close()


def test_a_call_is_executed_and_answered(driver, robot):
    robot.bus.forget()
    lift(driver, 'one', 17)
    driver.until(lambda page: page.calls.get('one', {}).get('outcome'), 'the answer')
    assert driver.calls['one']['outcome'] == 'done' and 'lift up 17 mm' in driver.calls['one'][
        'words']
    assert [request.data for request in robot.lift_requests] == [bytes((0, 17))]


def test_a_double_click_moves_once(driver, robot):
    robot.bus.forget()
    for key in ('first', 'second', 'third'):
        lift(driver, key)
    driver.until(lambda page: page.calls.get('first', {}).get('outcome'), 'the answer')
    lift(driver, 'fourth')     # immediately after the answer
    driver.until(lambda page: page.known.get('refused', {}).get('key') == 'fourth', 'refused')
    assert len(robot.lift_requests) == 1
    assert not {'second', 'third', 'fourth'} & set(driver.calls)


def test_the_outcome_of_a_call_without_reply_is_not_known(driver, robot):
    until(lambda: time.monotonic() - driver.now < 1, 'the page is up to date')
    robot.bus.script.append(b'')
    driver.until(lambda page: try_lift(page, 'lost'), 'the call is accepted')
    driver.until(lambda page: page.calls['lost'].get('outcome'), 'the answer')
    assert driver.calls['lost']['outcome'] == 'not known'


def call_custom(page, name):
    """Call a custom function, and wait for its answer; again if this machine stalled the bridge."""
    page.until(lambda page: name in page.known.get('controls', {}).get('services', ()), name)

    def answer():
        key = f'{name} at {time.monotonic()}'        # a page also receives earlier calls
        page.send(call={'key': key, 'name': name, 'arguments': {}})
        page.until(lambda page: page.calls.get(key, {}).get('outcome'), 'the answer')
        return 'while the bridge stalled' not in page.calls[key]['words'] and page.calls[key]
    return until(answer, 'the bridge does not stall')


@pytest.mark.parametrize('name', ['~beep', '~dock'])
def test_the_outcome_of_a_call_answered_too_late_is_not_known(driver, robot, name):
    """Also if the type of the response has no status."""
    answered = threading.Event()

    def late(request):
        answered.wait(PATIENCE)
        return robot.bus.usual(request)
    robot.bus.script.append(late)
    try:
        call = call_custom(driver, name)
    finally:
        answered.set()
    assert call['outcome'] == 'not known'
    assert call['words'] == ('no reply within 0.3 s: it is not known whether this was executed; '
                             'look before you repeat it')


@pytest.mark.parametrize('name', ['~beep', '~dock'])
def test_a_call_that_the_board_refused_is_shown_as_refused(driver, robot, name):
    robot.bus.script.append(bus.Reply(bus.ERROR, b'\2\x80'))
    call = call_custom(driver, name)
    assert (call['outcome'], call['words']) == (
        'refused', 'the board refused: 0x8002: the operation failed')


def test_the_reply_of_a_custom_function_is_shown_field_by_field(driver, robot):
    robot.bus.script.append(bus.Reply(bus.OK, bytes.fromhex('d204 0000 b841')))
    call = call_custom(driver, '~weigh')
    assert call['outcome'] == 'done'
    assert call['reply'] == [['environment.smoke', '1234'], ['environment.temperature', '23'],
                             ['environment.humidity', '0']]


def test_the_reply_of_a_call_that_failed_is_not_shown(driver, robot):
    robot.bus.script.append(bus.Reply(bus.ERROR, b'\2\x80'))
    call = call_custom(driver, '~weigh')
    assert (call['outcome'], call['reply']) == ('refused', [])


def test_the_outcome_of_a_call_is_not_known_if_the_bridge_dies(driver, robot):
    until(lambda: time.monotonic() - driver.now < 1, 'the page is up to date')
    robot.bus.script.append(lambda request: robot.bridge.process.kill() or b'')
    call = call_custom(driver, '~beep')
    robot.start_bridge()
    assert call['outcome'] == 'not known' and 'look before you repeat it' in call['words']


def try_lift(page, key):
    """Call, unless an earlier try was accepted: the page may not be up to date yet."""
    if key not in page.calls:
        lift(page, key)
        time.sleep(0.2)
    return key in page.calls


@pytest.mark.parametrize('name, arguments, words', [
    ('~lift', {'direction': 0}, 'takes direction, distance'),
    ('~lift', {'direction': 0, 'distance': 300}, '~lift'),
    ('~lift', {'direction': 0, 'distance': 'x'}, '~lift'),
    ('~get_loggers', {}, 'not a service'), ('/rosout/get_loggers', {}, 'not a service')])
def test_invalid_calls_are_refused(driver, robot, name, arguments, words):
    robot.bus.forget()
    driver.send(call={'key': 'wrong', 'name': name, 'arguments': arguments})
    driver.until(lambda page: page.known.get('refused', {}).get('key') == 'wrong', 'refused')
    assert words in driver.known['refused']['words'] and not robot.lift_requests


_SERVICE = """
from std_msgs.msg import Float32
from std_srvs.srv import SetBoolResponse

class Set:
    _type, _md5sum = 'floats/Set', '0' * 32
    _request_class, _response_class = Float32, SetBoolResponse
"""


@pytest.fixture
def floats(core, tmp_path):
    """A panel of a bridge, simulated here, with a service that takes a number."""
    module = tmp_path / 'floats' / 'srv'
    module.mkdir(parents=True)
    (tmp_path / 'floats' / '__init__.py').touch()
    (module / '__init__.py').write_text(_SERVICE)
    rospy.set_param('~bus/functions/set', {'srv_type': 'floats/Set'})
    there = rospy.Publisher('~there', String, queue_size=1)
    panel = Panel('--control', '--token', TOKEN, '--node', rospy.get_name(), name='panel_floats',
                  environment={'PYTHONPATH': f'{tmp_path}:{os.environ["PYTHONPATH"]}'})
    yield panel
    assert panel.end() == 0
    there.unregister()
    rospy.delete_param('~bus')


@pytest.mark.parametrize('number, is_json', [
    ('NaN', False), ('1e999', False), ('-Infinity', False), ('1e39', True),
    ('1' + '0' * 400, True)], ids=['nan', 'overflow', 'infinity', 'beyond float32', 'integer'])
def test_a_call_with_an_invalid_number_does_not_disturb_other_pages(floats, number, is_json):
    page, other = Page(floats, TOKEN).settle(), Page(floats, TOKEN)
    page.until(lambda page: '~set' in page.known.get('controls', {}).get('services', ()),
               'the service is offered')
    page.write(b'{"seen": %f, "call": {"key": "odd", "name": "~set", "arguments": {"data": %s}}}'
               % (page.now, number.encode()))
    if is_json:
        page.until(lambda page: page.known.get('refused', {}).get('key') == 'odd', 'refused')
        assert not page.closed
    else:
        until(lambda: 'invalid message' in page.closed, 'it is dropped')
    seen = other.now
    other.until(lambda page: page.now > seen + 0.5, 'others receive updates')
    assert not other.closed and 'odd' not in other.calls
    page.close()
    other.close()


def test_led_text_is_sent_and_too_long_a_one_is_refused(driver, robot):
    driver.until(lambda page: send_led(page, robot), 'the car receives it')
    driver.until(lambda page: page.calls.get('led', {}).get('outcome') == 'sent', 'the answer')
    assert driver.calls['led']['words'] == 'to the bridge; this command has no answer'
    driver.send(led={'key': 'long', 'text': 'x' * 31})
    driver.until(lambda page: page.known.get('refused', {}).get('key') == 'long', 'refused')


def gripper(page, key, **values):
    page.send(send={'key': key, 'name': '~gripper', 'values': values})


def test_a_custom_command_reaches_the_board_and_values_out_of_range_are_refused(driver, robot):
    driver.until(lambda page: '~gripper' in page.known.get('controls', {}).get('messages', ()),
                 'it is offered')

    def try_it():
        if 'good' not in driver.calls:
            gripper(driver, 'good', x=-2.5, y=50, z=3)
            time.sleep(0.2)
    until(lambda: GRIPPER in robot.car.wire, 'the board receives it', doing=try_it)
    driver.until(lambda page: page.calls.get('good', {}).get('outcome') == 'sent', 'the answer')
    gripper(driver, 'twice', x=-2.5, y=50, z=3)
    time.sleep(0.6)
    gripper(driver, 'wrong', x=-2.5, y=50.1, z=3)
    refused = {}

    def collect(page):
        refused.update((update['refused']['key'], update['refused']['words'])
                       for update in list(page.updates) if 'refused' in update)
        return {'twice', 'wrong'} <= set(refused)
    driver.until(collect, 'both are refused')
    assert refused['twice'] == '~gripper: one call at a time; wait for the answer'
    assert refused['wrong'] == 'gripper: y is 50.1, out of range (0 … 50)'
    assert robot.car.wire.count(GRIPPER) == 1


def test_stop_ends_the_driving_of_another_page_however_old_it_is(driver, control_panel, robot):
    other = Page(control_panel, TOKEN)
    other.until(lambda page: 'node' in page.known, 'the other page receives updates')
    hold = drive_until(driver, drives(robot), 'the car drives')

    def keep_driving():
        drive(driver, hold)
    other.send(seen=0, stop={'key': 'stop'})
    until(has_stopped(robot), 'the car stops', doing=keep_driving, every=0.04)
    other.until(lambda page: page.calls.get('stop', {}).get('outcome') == 'sent', 'the answer')
    count = len(robot.car.speeds)
    for _ in range(10):
        keep_driving()
    driver.until(lambda page: 'press again' in page.known.get('refused', {}).get('words', ''),
                 'the hold that was ended is refused')
    assert not any(robot.car.speeds[count:])
    other.close()


def send_led(page, robot):
    page.send(led={'key': 'led', 'text': 'left'})
    time.sleep(0.05)
    return arduino.encode(arduino.LedCommand('left')) in robot.car.raw_commands


# -- driving ----------------------------------------------------------------------------------


def drive(page, hold, speed=150, seen=None, steering=1600):
    page.send(drive={'key': 'drive', 'hold': hold, 'seen': page.now if seen is None else seen,
                     'speed': speed, 'steering': steering})


def drive_until(page, condition, what, speed=150):
    """Hold the pad until the condition is true; return the number of the hold.

    If the machine stalls for too long, the hold ends, and another one begins.
    """
    def hold_on():
        if 'refused' in page.known:
            del page.known['refused']
            page.holds += 1
        drive(page, page.holds, speed)
    page.holds += 1
    until(condition, what, doing=hold_on, every=0.04)
    return page.holds


def drives(robot, speed=150):
    return lambda: speed in robot.car.speeds


def has_stopped(robot):
    """Whether the latest speed that the car has received is 0."""
    return lambda: robot.car.speeds and robot.car.speeds[-1] == 0


def test_release_stops_the_car(driver, robot):
    hold = drive_until(driver, drives(robot), 'the car drives')
    driver.send(release={'hold': hold})
    until(has_stopped(robot), 'the car stops')
    count = len(robot.car.speeds)
    drive(driver, hold)
    driver.until(lambda page: 'press again' in page.known.get('refused', {}).get('words', ''),
                 'a command of the hold that has ended is refused')
    assert robot.car.speeds[count:] in ([], [0])


def test_silence_stops_the_car(driver, robot):
    drive_until(driver, drives(robot), 'the car drives')
    until(has_stopped(robot), 'the car stops')
    driver.until(lambda page: page.known['drive'] == {
        'held': False, 'words': 'stopped: no command from the page for 0.2 s'}, 'the page shows it')
    # The panel stopped the car before the bridge's own timeout of 0.5 s had to.
    assert robot.car.frames[-1].stamp


def test_a_lost_connection_stops_the_car(driver, robot):
    drive_until(driver, drives(robot), 'the car drives')
    driver.close()
    until(has_stopped(robot), 'the car stops')


def test_delayed_commands_do_not_drive(driver, robot):
    old = driver.now
    driver.until(lambda page: page.now > old + 1, 'a second passes')
    for _ in range(5):
        drive(driver, 1, seen=old)
    driver.until(lambda page: any('too slow' in update.get('refused', {}).get('words', '')
                                  for update in list(page.updates)), 'they are refused')
    driver.holds = 1
    drive_until(driver, drives(robot, 120), 'recent commands drive', speed=120)
    assert 150 not in robot.car.speeds


def test_a_panel_that_was_suspended_does_not_continue_to_drive(driver, control_panel, robot):
    hold = drive_until(driver, drives(robot), 'the car drives')
    os.kill(control_panel.process.pid, signal.SIGSTOP)
    try:
        for _ in range(20):
            drive(driver, hold, speed=170)     # waits in the panel's socket
        until(has_stopped(robot), "the bridge's own timeout stops the car")
        robot.car.forget()
    finally:
        os.kill(control_panel.process.pid, signal.SIGCONT)
    seen = driver.now
    driver.until(lambda page: page.now > seen + 0.3, 'the panel continues')
    assert not [speed for speed in robot.car.speeds if speed]


def test_two_pages_do_not_drive_at_once(driver, control_panel, robot):
    other = Page(control_panel, TOKEN)
    other.settle()
    hold = drive_until(driver, drives(robot), 'the car drives')

    def both():
        drive(driver, hold)
        drive(other, 1, speed=-90)
    until(lambda: 'another page drives' in other.known.get('refused', {}).get('words', ''),
          'the other is refused', doing=both, every=0.04)
    assert -90 not in robot.car.speeds
    other.close()


def test_the_car_stops_when_the_panel_ends(robot):
    panel = Panel('--control', '--token', TOKEN, name='panel_third')
    page = Page(panel, TOKEN).settle()
    robot.car.forget()
    drive_until(page, drives(robot), 'the car drives')
    panel.process.send_signal(signal.SIGTERM)
    until(has_stopped(robot), 'the car stops')
    assert panel.end() == 0


class Teleop:
    """Another program that commands the car: this process, 20 times a second.

    Args:
        speed: None: it sends nothing.
    """

    def __init__(self, speed=None):
        self.speed = speed
        self._topic = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=1,
                                      tcp_nodelay=True)
        self._ended = threading.Event()
        threading.Thread(target=self._publish, daemon=True).start()

    def _publish(self):
        while not self._ended.wait(0.05):
            if self.speed is not None:
                self._topic.publish(value=self.speed)

    def is_heard_by(self, *nodes):
        """Whether these nodes are connected."""
        return all(self._topic.impl.has_connection(node) for node in nodes)

    def end(self):
        """Publish no more."""
        self._ended.set()
        self._topic.unregister()


@pytest.fixture
def teleop(driver, control_panel, robot):
    """Another program that drives, at 300."""
    teleop = Teleop(300)
    until(lambda: teleop.is_heard_by(NODE, control_panel.node), 'bridge and panel hear it')
    until(drives(robot, 300), 'it drives')
    yield teleop
    teleop.end()
    driver.send(stop={'key': 'over'})
    until(has_stopped(robot), 'the car stops')


def is_refused(words):
    """Whether a command of the page was refused with these words."""
    return lambda page: words in page.known.get('refused', {}).get('words', '')


def test_no_page_drives_while_another_program_does(driver, teleop, robot):
    holds = count(1)

    def is_the_only_one():
        robot.car.forget()
        for hold in islice(holds, 20):
            drive(driver, hold)
            time.sleep(0.04)
        driver.until(is_refused('/panel_test commands the car'), 'it is refused, with the reason')
        return set(robot.car.speeds) <= {300}
    # If this machine stalls the other program for half a second, the page may drive.
    assert any(is_the_only_one() for _ in range(5)), robot.car.speeds


def test_a_speed_0_of_another_program_ends_a_hold(driver, control_panel, robot):
    other = Teleop()
    try:
        until(lambda: other.is_heard_by(NODE, control_panel.node), 'bridge and panel hear it')
        hold = drive_until(driver, drives(robot), 'the car drives')
        other.speed = 0
        until(lambda: is_refused('/panel_test commands the car')(driver), 'the hold has ended',
              doing=lambda: drive(driver, hold), every=0.04)
        until(has_stopped(robot), 'the car stops')
        count = len(robot.car.speeds)
        for _ in range(20):
            drive(driver, hold)
            time.sleep(0.04)
        assert not any(robot.car.speeds[count:])
    finally:
        other.end()


def test_stop_is_repeated_against_a_program_that_goes_on_and_says_so(driver, teleop, robot):
    robot.car.forget()
    driver.send(stop={'key': 'against'})
    driver.until(lambda page: page.calls.get('against', {}).get('outcome') == 'not known',
                 'the page says that it goes on')
    assert '/panel_test goes on sending speeds' in driver.calls['against']['words']
    assert robot.car.speeds.count(0) >= 3
    teleop.speed = 0
    until(has_stopped(robot), 'the car stops')


def test_two_panels_do_not_drive_at_once(driver, robot):
    second = Panel('--control', '--token', TOKEN, name='panel_beside')
    other = Page(second, TOKEN)
    try:
        other.settle()
        until(lambda: second.node in publishers_and_subscribers()[1].get(NODE + '/speed', ()),
              'it watches the speeds')
        hold = drive_until(driver, drives(robot), 'the car drives')

        def both():
            drive(driver, hold)
            drive(other, 1, speed=-90)
        until(lambda: 'commands the car' in other.known.get('refused', {}).get('words', ''),
              'the other is refused', doing=both, every=0.04)
        robot.car.forget()
        for step in range(20):
            drive(driver, hold)
            drive(other, 2 + step, speed=-90)
            time.sleep(0.04)
        signs = [speed > 0 for speed in robot.car.speeds if speed]
        assert sum(one != next_ for one, next_ in zip(signs, signs[1:])) == 0
        # STOP on the second ends the driving of the first.
        hold = drive_until(driver, drives(robot, 130), 'the car drives', 130)
        other.send(stop={'key': 'second'})
        until(has_stopped(robot), 'the car stops', doing=lambda: drive(driver, hold, 130),
              every=0.04)
        count = len(robot.car.speeds)
        for _ in range(20):
            drive(driver, hold, 130)
            time.sleep(0.04)
        assert not any(robot.car.speeds[count:])
    finally:
        other.close()
        assert second.end() == 0


# -- a master, a bridge or a panel that hangs -------------------------------------------------


def wait(seconds):
    began = time.monotonic()
    until(lambda: time.monotonic() - began > seconds, 'the time has passed')


def test_pages_and_driving_continue_while_the_master_hangs(driver, control_panel, robot, core):
    other = Page(control_panel, TOKEN)
    other.until(lambda page: 'node' in page.known, 'the other page receives updates')
    hold = drive_until(driver, drives(robot), 'the car drives')
    with core.hung():
        other.send(watch=TOPICS + ['serial_msg'])
        wait(0.5)
        seen = other.now
        other.until(lambda page: page.now > seen + 0.5, 'pages receive updates')
        robot.car.forget()
        hold = drive_until(driver, drives(robot), 'the car drives while the master hangs')
        driver.send(release={'hold': hold})
        until(has_stopped(robot), 'the car stops')
        robot.car.forget()
        drive_until(driver, drives(robot), 'the car drives again')
        until(has_stopped(robot), 'the car stops without commands of the page')
    other.until(lambda page: page.known.get('wire', {}).get('frames'), 'frames are received')
    other.close()


def test_publishers_exist_only_while_a_page_is_open(control_panel, robot, core):
    def publishes():
        return control_panel.node in publishers_and_subscribers()[0].get(NODE + '/speed', ())
    page = Page(control_panel, TOKEN)
    until(publishes, 'the panel publishes')
    with core.hung():
        page.close()
        wait(2)
        page = Page(control_panel, TOKEN)
        page.until(lambda page: 'node' in page.known, 'the page receives updates')
    robot.car.forget()
    drive_until(page, drives(robot), 'the car drives')
    page.close()
    until(lambda: not publishes(), 'the panel publishes no more')


def nothing(_panel):
    pass


def show_wire(panel):
    """Let the panel subscribe to serial_msg."""
    Page(panel, TOKEN, watch=['serial_msg'])
    wait(0.3)


def call(panel):
    """Let the panel look up a service."""
    page = Page(panel, TOKEN).settle()
    lift(page, 'key')
    page.until(lambda page: 'key' in page.calls, 'the call is under way')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('action', [nothing, show_wire, call])
def test_a_signal_ends_the_panel_while_the_master_hangs(robot, core, number, action):
    panel = Panel('--control', '--token', TOKEN, name='panel_hung')
    page = Page(panel, TOKEN)
    page.until(lambda page: page.known.get('trouble') == '', 'it is registered and subscribes')
    with core.hung():
        action(panel)
        assert panel.end(number) == 0
    assert 'Traceback' not in panel.output()


def test_a_signal_ends_a_panel_that_starts_while_the_master_hangs(core):
    with core.hung():
        panel = Panel(name='panel_hung')
        assert panel.end() == 0


def test_a_terminal_that_reads_nothing_does_not_delay_pages(robot):
    reads, writes = os.pipe()
    port = free_port()
    panel = subprocess.Popen([program('panel'), '--port', str(port), '__name:=panel_mute'],
                             stdout=writes, stderr=writes)
    try:
        until(lambda: b'http://' in os.read(reads, 1000), 'it listens')
        place = types.SimpleNamespace(port=port)
        page = Page(place)
        page.until(lambda page: page.known.get('trouble') == '', 'it is a node and logs')
        os.set_blocking(writes, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writes, bytes(1000))
        os.set_blocking(writes, True)       # the panel's output shares this setting
        assert Page(place, origin='http://evil.example').status == 403     # is logged
        seen = page.now
        page.until(lambda page: page.now > seen + 0.5, 'the page receives updates')
        panel.send_signal(signal.SIGINT)
        assert panel.wait(PATIENCE) == 0
    finally:
        panel.kill()
        os.close(reads)
        os.close(writes)


def test_a_call_delayed_by_the_master_moves_nothing(driver, robot, core):
    robot.bus.forget()
    with core.hung():
        lift(driver, 'late')
        driver.until(lambda page: 'late' in page.calls, 'the call is under way')
        wait(2.5)
        assert not driver.calls['late'].get('outcome')
    driver.until(lambda page: page.calls['late'].get('outcome'), 'the answer')
    assert driver.calls['late']['outcome'] == 'refused'
    assert 'nothing was sent' in driver.calls['late']['words']
    assert not robot.lift_requests


def test_a_call_delayed_by_the_bridge_moves_nothing(driver, robot):
    robot.bus.forget()
    os.kill(robot.bridge.process.pid, signal.SIGSTOP)
    try:
        lift(driver, 'late')
        driver.until(lambda page: 'late' in page.calls, 'the call is under way')
        wait(2.5)
    finally:
        os.kill(robot.bridge.process.pid, signal.SIGCONT)
    driver.until(lambda page: page.calls['late'].get('outcome'), 'the answer')
    assert driver.calls['late']['outcome'] == 'refused'
    assert 'nothing was sent' in driver.calls['late']['words']
    assert not robot.lift_requests


def test_a_call_delayed_by_the_panel_moves_nothing(driver, control_panel, robot):
    robot.bus.forget()
    led = arduino.encode(arduino.LedCommand('old'))
    os.kill(control_panel.process.pid, signal.SIGSTOP)
    try:
        lift(driver, 'late')
        driver.send(led={'key': 'old', 'text': 'old'})
        wait(2.5)
    finally:
        os.kill(control_panel.process.pid, signal.SIGCONT)
    for key in ('late', 'old'):
        driver.until(lambda page, key=key: any(
            update.get('refused', {}).get('key') == key for update in list(page.updates)),
            f'{key} is refused')
    assert not robot.lift_requests and led not in robot.car.raw_commands
