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
from boards import PACKAGE, PATIENCE, Master, again_if_stalled, program, settle, until
from panel_helpers import (KEPT_BACK, NODE, TOKEN, Page, Panel, publishers_and_subscribers, request,
                           subscribed, suspended)

from std_msgs.msg import Float32

from serial_communication.boards.arduino import settings as read_settings
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.msg import SpeedPWMCommand
from serial_communication.tools.panel import commands
from serial_communication.tools.panel.dead_man import CommandRefused

MASK = bytes(4)      # of a WebSocket frame
TOPICS = ['~imu', '~voltage', '~environment', 'mcu/range_1', '~nothing']


@pytest.fixture
def page(panel):
    with Page(panel, watch=TOPICS) as page:
        yield page


@pytest.fixture(scope='module')
def two_pages(panel):
    """A page that acknowledges nothing, and one that does.

    The first is dropped after 5 s, during which other tests run.
    """
    return Page(panel, acknowledges=False), Page(panel)


@pytest.fixture
def driver(control_panel, robot):
    """A page that may drive, and whose commands the bridge receives."""
    with Page(control_panel, TOKEN) as page:    # a page left open would disturb later tests
        page.settle()
        until(lambda: robot.car.connected, 'the car is connected')
        until(lambda: publishes(control_panel), 'the panel publishes speeds')
        robot.car.forget()
        settle(PACKAGE, robot.bus)
        yield page
    until(lambda: not page.known.get('drive', {}).get('held') or page.closed, 'no page drives')


def publishes(panel):
    """Whether the master knows it as a publisher of speeds."""
    return panel.node in publishers_and_subscribers()[0].get(NODE + '/speed', ())


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


def test_two_panels_without_a_port_take_different_ones(robot):
    with Panel(port=None, name='panel_first') as first, \
            Panel(port=None, name='panel_second') as second:
        assert 8080 <= first.port < second.port
        # Another program may have had the port before.
        holder = f'panel (pid {first.process.pid}); the next' if first.port == 8080 else ''
        second.wait_for(f'port 8080 is taken by {holder}')
        for panel in first, second:
            with Page(panel, watch=TOPICS) as page:
                page.until(lambda page: '~imu' in page.samples, 'it shows the bridge')


def test_at_a_new_master_the_panel_starts_again_with_its_port_and_token():
    master = Master().start()
    try:
        with Panel('--control', name='panel_again',
                   environment={'ROS_MASTER_URI': master.uri}) as panel:
            def is_known():
                return master.server.is_online() and '/panel_again' in str(
                    master.server.getSystemState())
            until(is_known, 'it is registered')
            master.end()
            assert panel.exchange(panel.token)[0] == 200
            master.start()
            until(is_known, 'it is registered again')
            assert panel.exchange(panel.token)[0] == 200
            with open(f'/proc/{panel.process.pid}/cmdline') as command_line:
                assert panel.token not in command_line.read()
    finally:
        master.end()


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
        # Also without --control, everybody else on the network is refused.
        port = int(re.search(r':(\d+)/', url).group(1))
        assert request(port, '/key', None, {})[0] == 401
    finally:
        panel.terminate()
        panel.wait(PATIENCE)
        os.close(near)


def test_without_a_master_the_panel_serves_pages_that_say_so():
    with Panel(environment={'ROS_MASTER_URI': 'http://127.0.0.1:1'}) as panel, Page(panel) as page:
        panel.wait_for('panel: waiting for the ROS master at http://127.0.0.1:1; start one with')
        page.until(lambda page: 'no answer from the ROS master' in page.known.get('trouble', ''),
                   'the page shows it')


_NAME_TAKEN = '''
import sys, rospy
from serial_communication.tools.panel import cli
def init_node(*arguments, **keywords):
    raise rospy.ROSInitException('init_node interrupted before it could complete')
rospy.init_node = init_node
sys.exit(cli.main(['--port', '0']))
'''


@pytest.mark.usefixtures('robot')
def test_a_name_taken_during_registration_ends_the_panel():
    done = subprocess.run(['/usr/bin/python3', '-c', _NAME_TAKEN], text=True, timeout=PATIENCE,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert done.returncode == 1, done.stderr
    assert done.stderr.count('ROS has ended this node') == 1 and 'Traceback' not in done.stderr


def test_a_second_panel_of_the_same_name_ends_and_the_first_continues(panel):
    second = Panel(name='panel_read_only')
    assert second.process.wait(PATIENCE) == 3
    second.wait_for('another node is named /panel_read_only')
    second.wait_for('or name this one: __name:=panel_read_only_2')
    assert 'Traceback' not in second.output()
    with Page(panel, watch=TOPICS) as page:
        page.until(lambda page: '~imu' in page.samples, 'the first continues')


def test_a_name_taken_later_ends_the_panel(robot):
    panel = Panel(name='panel_taken')
    until(lambda: is_registered('/panel_taken'), 'it is registered')
    rosgraph.Master('/panel_taken').registerSubscriber(
        '/chatter', 'std_msgs/String', 'http://localhost:1/')
    assert panel.process.wait(PATIENCE) == 1
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


def test_a_foreign_origin_is_refused(panel, control_panel):
    for origin in 'http://evil.example', 'null':
        assert Page(panel, origin=origin).status == panel.get('/app.js', Origin=origin)[0] \
            == control_panel.exchange(TOKEN, Origin=origin)[0] == 403
    assert Page(panel, origin=None).status == control_panel.exchange(TOKEN, Origin='')[0] == 403
    assert panel.get('/app.js', Origin=f'http://127.0.0.1:{panel.port}')[0] == 200


def test_a_connection_needs_the_token(control_panel):
    assert control_panel.url.endswith(f'/#{TOKEN}')
    status, headers, _text = control_panel.get('/')
    assert status == 200 and 'Set-Cookie' not in headers       # the files are the same everywhere
    assert Page(control_panel).status == 401
    assert control_panel.get('/key')[0] == 401
    status, headers, key = control_panel.exchange(TOKEN)
    assert status == 200 and 'Set-Cookie' not in headers
    assert headers['Cache-Control'] == 'no-store'
    assert control_panel.get('/key', X_Key=key)[0] == 200
    status, _headers, text = control_panel.exchange('not-the-right-one')
    assert status == 401 and 'its token is wrong' in text
    with Page(control_panel, TOKEN) as page:
        assert page.status == 101
    # Printed once, in the address, and never logged.
    assert control_panel.output().count(TOKEN) == 1


def test_a_token_from_a_file_is_on_no_command_line(control_panel):
    with open(f'/proc/{control_panel.process.pid}/cmdline') as command_line:
        assert TOKEN not in command_line.read()


def test_on_loopback_a_name_of_this_machine_is_refused(panel, control_panel):
    """A proxy or a tunnel that others reach is behind it."""
    for each in panel, control_panel:
        for host in socket.gethostname(), '192.168.1.7', 'evil.example':
            status, _headers, text = each.get('/', Host=f'{host}:{each.port}')
            assert status == 403 and 'is not a name of this machine on loopback' in text
            assert Page(each, host=f'{host}:{each.port}').status == 403
        assert each.get('/', Host='127.0.0.1')[0] == each.get('/', Host='localhost')[0] == 200
        each.wait_for('is not a name of this machine')


def test_a_page_that_sends_too_often_or_invalid_messages_is_dropped(panel):
    for message in (b'{', b'[1]', b'{"watch": 5}', b'{"drive": 1}', b'{"seen": NaN}',
                    b'{"seen": 1e999}', b'{"release": {"hold": 1e999}}',
                    b'{"release": {"hold": -Infinity}}',
                    b'{"seen": 1%s, "led": {"text": ""}}' % (b'0' * 400), b'[' * 4000):
        page = Page(panel)
        page.write(message)
        until(lambda: 'sent an invalid message' in page.closed, f'{message} is refused')
    page = Page(panel)
    page.send_raw((b'\x81\x8b' + MASK + b'{"seen": 0}') * 4000)
    until(lambda: 'more than 120 frames a second' in page.closed, 'it is dropped')
    page = Page(panel)
    page.write(json.dumps({'watch': ['x' * 40000]}).encode())
    until(lambda: page.closed, 'a message that is too long closes the connection')


def test_a_page_may_watch_the_topics_of_hundreds_of_custom_messages(panel):
    names = [f'~a_custom_message_with_a_long_name_{number}' for number in range(500)]
    with Page(panel, watch=[*names, *TOPICS]) as page:
        page.until(lambda page: '~imu' in page.samples, 'updates are received')
        assert not page.closed


@pytest.fixture
def other_page(panel):
    """A page that must continue whatever another one does."""
    with Page(panel, watch=TOPICS) as page:
        page.until(lambda page: '~imu' in page.samples, 'updates are received')
        yield page
        continues(page)


def continues(page):
    """Check that a page still receives updates."""
    seen = page.now
    page.until(lambda page: page.now > seen + 0.5, 'updates are received')
    assert not page.closed


@pytest.mark.parametrize('frame, reads', [
    (b'\x89\x80' + MASK, True), (b'\x89\xfd' + MASK + bytes(125), False),
    (b'\x8a\x80' + MASK, True), (b'\x00\x80' + MASK, True)],
    ids=['pings', 'long pings, reads nothing', 'pongs', 'fragments'])
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


_SMALL_BUFFERS = '''
import socket
listen = socket.socket.listen
def listen_with_small_buffers(self, *arguments):
    self.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)      # its connections inherit it
    listen(self, *arguments)
socket.socket.listen = listen_with_small_buffers
'''


def test_a_page_that_reads_nothing_is_dropped_whatever_it_acknowledges(robot, tmp_path):
    """With the system's own buffers that would take half a minute."""
    (tmp_path / 'sitecustomize.py').write_text(_SMALL_BUFFERS)
    with Panel(name='panel_unread', environment={
            'PYTHONPATH': f'{tmp_path}:{os.environ["PYTHONPATH"]}'}) as panel, \
            Page(panel, watch=TOPICS, reads=False) as page:
        until(lambda: 'dropped a page at 127.0.0.1: it does not read' in panel.output(),
              'it is dropped', seconds=60, doing=lambda: page.send(seen=1e18), every=0.1)


def test_idle_connections_do_not_keep_other_pages_out(robot):
    with Panel(name='panel_crowded') as panel:
        before = Page(panel, watch=TOPICS)
        before.until(lambda page: '~imu' in page.samples, 'numbers are received')
        resource.prlimit(panel.process.pid, resource.RLIMIT_NOFILE, (160, 160))
        idle = [socket.create_connection(('127.0.0.1', panel.port)) for _ in range(300)]
        later = Page(panel, watch=TOPICS)
        later.until(lambda page: '~imu' in page.samples, 'another page is served')
        assert panel.get('/app.js')[0] == 200
        continues(before)
        for each in idle:
            each.close()
    assert 'Too many open files' not in panel.output()


def test_dropped_pages_that_stay_connected_do_not_keep_others_out(panel, other_page):
    with contextlib.ExitStack() as stack:
        for _ in range(80):
            stack.enter_context(Page(panel, reads=False)).write(b'{')
        later = stack.enter_context(Page(panel, watch=TOPICS))
        later.until(lambda page: '~imu' in page.samples, 'another page is served')


def test_a_slow_page_is_dropped_and_the_others_are_not(panel, two_pages):
    slow, other = two_pages
    until(lambda: 'does not read' in slow.closed, 'the slow one is dropped')
    assert not other.closed
    panel.wait_for('it does not read what is sent to it')
    other.close()       # there is room for 16


def test_the_17th_page_is_refused(panel):
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(Page(panel)) for _ in range(16)]
        assert {page.status for page in pages} == {101}
        assert Page(panel, patient=False).status == 503
        pages[0].close()
        assert stack.enter_context(Page(panel)).status == 101


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


def test_a_page_opened_later_receives_the_history(page, panel):
    page.until(lambda page: '~environment' in page.samples, 'the air')
    with Page(panel, watch=TOPICS) as later:
        later.until(lambda page: page.updates, 'the first update')
        assert 'smoke' in later.updates[0]['topics']['~environment']['fields'][0]


# -- commands ---------------------------------------------------------------------------------


def test_a_read_only_panel_takes_no_commands(page, robot):
    before = len(robot.lift_requests)
    lift(page, 'a')
    page.until(lambda page: page.refusals, 'it is refused')
    assert 'read-only' in page.refusals['a'] and len(robot.lift_requests) == before
    assert 'controls' not in page.known
    assert not any('/panel_read_only' in publishers_and_subscribers()[0].get(NODE + name, ())
                   for name in ('/speed', '/steering', '/led'))


def lift(page, key, distance=5):
    call(page, key, '~lift', direction=0, distance=distance)


def call(page, key, name, **arguments):
    page.send(call={'key': key, 'name': name, 'arguments': arguments})


def wait_for_answer(page, key):
    """Wait until a call has an outcome; return the answer."""
    page.until(lambda page: page.calls.get(key, {}).get('outcome'), 'the answer')
    return page.calls[key]


def wait_until_refused(page, *keys):
    """Wait until all these commands were refused; return why, for each."""
    page.until(lambda page: set(keys) <= set(page.refusals), f'{keys} are refused')
    return [page.refusals[key] for key in keys]


_KEYS = count()      # of commands: a page also receives the calls of earlier ones


def why_refused(page, *sends):
    """Why commands are refused, which these functions send with a key; again if a stall of this
    machine kept one back."""
    def reasons():
        keys = [f'refused {next(_KEYS)}' for _ in sends]
        for send, key in zip(sends, keys):
            send(key)
        words = wait_until_refused(page, *keys)
        return words if not any(map(KEPT_BACK.search, words)) else None
    return again_if_stalled(reasons)


def call_until_known(page, robot, name, reply=None, **arguments):
    """Call a function, to which the board sends `reply` (None: the usual one), and return the
    answer; again if a stall dropped the request or the reply."""
    def answered():
        settle(PACKAGE, robot.bus)      # a request may still be on its way
        robot.bus.script.append(reply)
        answer = page.call(name, **arguments)
        return answer['outcome'] != 'not known' and answer
    return again_if_stalled(answered)


def test_a_page_that_has_just_been_opened_takes_no_command_but_stop(control_panel, robot):
    def refused_early():
        robot.car.forget()
        settle(PACKAGE, robot.bus)
        with Page(control_panel, TOKEN) as page:
            last = f'early {next(_KEYS)}'
            page.send(stop={'key': 'early stop'})
            drive(page, 1)
            page.send(led={'key': 'early led', 'text': 'left'})
            lift(page, last)
            page.until(lambda page: last in page.refusals
                       or page.calls.get(last, {}).get('outcome'), 'the last one is answered')
            if last in page.calls:      # this machine stalled for longer than the first second
                return False
            words = set(wait_until_refused(page, last, 'early led', 'drive'))
            assert 'just appeared' not in page.refusals.get('early stop', '')
            page.settle()
        return words == {'nothing was sent: the page has just appeared; press again'}
    again_if_stalled(refused_early)
    assert not robot.lift_requests and not any(robot.car.speeds)


def test_a_call_is_executed_and_answered(driver, robot):
    found = call_until_known(driver, robot, '~lift', direction=0, distance=17)
    assert found['outcome'] == 'done' and 'lift up 17 mm' in found['words']
    assert [request.data for request in robot.lift_requests] == [bytes((0, 17))]


def test_a_double_click_moves_once(driver, robot):
    def clicked_often():
        settle(PACKAGE, robot.bus)      # a request may still be on its way
        first, *more, last = (f'{word} {next(_KEYS)}'
                              for word in ('first', 'second', 'third', 'last'))
        for key in first, *more:
            lift(driver, key)
        if not driver.answer(first):
            return False
        lift(driver, last)     # immediately after the answer
        driver.until(lambda page: last in page.refusals or last in page.calls, 'the last')
        return len(robot.lift_requests) == 1 and not {*more, last} & set(driver.calls)
    again_if_stalled(clicked_often)


@pytest.mark.parametrize('name', ['~beep', '~dock'])
def test_the_outcome_of_a_call_answered_too_late_is_not_known(driver, robot, name):
    """Also if the type of the response has no status."""
    answered = threading.Event()

    def late(request):
        answered.wait(PATIENCE)
        return robot.bus.usual(request)
    robot.bus.script.append(late)
    try:
        answer = driver.call(name)
    finally:
        answered.set()
    assert (answer['outcome'], answer['words']) == (
        'not known', 'no reply within 0.3 s: it is not known whether this was executed; '
        'check the robot before you repeat it')


_REFUSED = bus.Reply(bus.ERROR, b'\2\x80')
_WEIGHT = bus.Reply(bus.OK, bytes.fromhex('d204 0000 b841'))


def test_a_reply_is_shown_with_its_outcome_and_its_fields_if_it_is_done(driver, robot):
    for name in '~weigh', '~beep', '~dock':
        answer = call_until_known(driver, robot, name, _REFUSED)
        assert (answer['outcome'], answer['reply'], answer['words']) == (
            'refused', [], 'the board refused: 0x8002: the operation failed'), name
    answer = call_until_known(driver, robot, '~weigh', _WEIGHT)
    assert (answer['outcome'], answer['reply']) == (
        'done', [['environment.smoke', '1234'], ['environment.temperature', '23'],
                 ['environment.humidity', '0']])


def test_the_outcome_of_a_call_is_not_known_if_the_bridge_dies(driver, robot):
    until(lambda: time.monotonic() - driver.now < 1, 'the page is up to date')
    killed = []

    def kill(_request):
        robot.bridge.process.kill()
        killed.append(True)
        return b''

    def killed_by_its_call():
        # A call that a board without processor time has not received is dropped.
        settle(PACKAGE, robot.bus)
        robot.bus.script.append(kill)
        answer = driver.call('~beep')
        return answer if killed else None
    answer = again_if_stalled(killed_by_its_call)
    assert answer['outcome'] == 'not known' and 'before you repeat it' in answer['words']
    robot.start_bridge()


def test_invalid_calls_are_refused(driver, robot):
    for name, arguments, words in (
            ('~lift', {'direction': 0}, 'takes direction, distance'),
            ('~lift', {'direction': 0, 'distance': 300}, '~lift'),
            ('~lift', {'direction': 0, 'distance': 'x'}, '~lift'),
            ('~get_loggers', {}, 'not a service'), ('/rosout/get_loggers', {}, 'not a service')):
        why, = why_refused(driver, lambda key, name=name, arguments=arguments: call(
            driver, key, name, **arguments))
        assert words in why
    assert not robot.lift_requests
    # All times have the same digits: a page takes one that is before another for a restart.
    assert all(update['now'] == round(update['now'], 4) for update in list(driver.updates))


@pytest.mark.parametrize('number', [1e39, 10 ** 400])
def test_a_number_that_its_type_cannot_hold_is_refused(number):
    """Whether a page whose call is refused disturbs others: test_invalid_calls_are_refused."""
    takes_number = types.SimpleNamespace(_request_class=Float32)
    with pytest.raises(CommandRefused, match='~set: '):
        commands._request('~set', commands.Service(takes_number, 'bus', []), {'data': number})


@pytest.mark.parametrize('arguments', [
    {}, {'value': 11}, {'value': float('nan')}, {'value': 'fast'}, {'value': [1.0]}])
def test_a_value_that_a_setting_may_not_have_is_refused(arguments):
    kp, = read_settings({'kp': {'setting': 1, 'layout': '<f', 'maximum': 10}})
    with pytest.raises(CommandRefused, match='~kp may be a number to 10'):
        commands._request('~kp', commands.Service(None, 'arduino', [], setting=kp), arguments)


def test_what_a_message_cannot_carry_is_refused_and_so_is_a_second_one_at_once(driver):
    """Whether the others reach the board: test_browser.py."""
    def gripper(key, y):
        driver.send(send={'key': key, 'name': '~gripper', 'values': {'x': -2.5, 'y': y, 'z': 3}})

    def sent_twice():
        once, twice = (f'{word} {next(_KEYS)}' for word in ('once', 'twice'))
        gripper(once, 50)
        gripper(twice, 50)
        driver.until(lambda page: twice in page.refusals or twice in page.calls, 'the second')
        wait(0.6)
        return driver.calls.get(once, {}).get('outcome') == 'sent' \
            and driver.refusals.get(twice) == '~gripper: one call at a time; wait for the answer'
    driver.until(lambda page: '~gripper' in page.known.get('controls', {}).get('messages', ()),
                 'it is offered')
    again_if_stalled(sent_twice)
    wrong, long = why_refused(
        driver, lambda key: gripper(key, 50.1),
        lambda key: driver.send(led={'key': key, 'text': 'x' * 31}))
    assert wrong == 'gripper: y is 50.1, out of range (0 \u2026 50)'
    assert long.startswith('the LED takes at most 30 ASCII characters')


def wait(seconds):
    began = time.monotonic()
    until(lambda: time.monotonic() - began > seconds, 'the time has passed')


# -- driving; what the switch decides: test_dead_man.py -----------------------------------------


def drive(page, hold, speed=150, seen=None):
    page.send(drive={'key': 'drive', 'hold': hold, 'seen': page.now if seen is None else seen,
                     'speed': speed, 'steering': 1600})


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


def keep_driving(page, hold, times=20, speed=150):
    for _ in range(times):
        drive(page, hold, speed)
        time.sleep(0.04)


def drives(robot, speed=150):
    return lambda: speed in robot.car.speeds


def has_stopped(robot):
    """Whether the latest speed that the car has received is 0."""
    return lambda: robot.car.speeds and robot.car.speeds[-1] == 0


def is_refused(words):
    """Whether the latest refusal of the page has these words."""
    return lambda page: words in page.known.get('refused', {}).get('words', '')


def check_that_no_speed_follows(page, hold, robot, what):
    """Check that the car has stopped, and that a hold that was ended drives no more."""
    for _ in range(2):          # the second time no speed of the hold is on its way any more
        until(has_stopped(robot), what, doing=lambda: drive(page, hold), every=0.04)
        keep_driving(page, hold, 5)
    count = len(robot.car.speeds)
    keep_driving(page, hold)
    assert not any(robot.car.speeds[count:])


def test_release_stops_the_car(driver, robot):
    hold = drive_until(driver, drives(robot), 'the car drives')
    driver.send(release={'hold': hold})
    check_that_no_speed_follows(driver, hold, robot, 'the car stops')
    driver.until(is_refused('press again'), 'a command of the hold that has ended is refused')


def test_silence_stops_the_car(driver, robot):
    def silence_stopped():
        robot.car.forget()
        drive_until(driver, drives(robot), 'the car drives')
        until(has_stopped(robot), 'the car stops')
        driver.until(lambda page: not page.known['drive']['held'], 'the page shows it')
        # The panel stopped the car before the bridge's own timeout of 0.5 s had to.
        return driver.known['drive']['words'] == 'stopped: no command from the page for 0.2 s'
    again_if_stalled(silence_stopped)


def test_a_lost_connection_stops_the_car(driver, control_panel, robot):
    def loss_stopped():
        robot.car.forget()
        with Page(control_panel, TOKEN).settle() as lost:
            drive_until(lost, lambda: drives(robot)() and driver.known['drive']['held'],
                        'the car drives, and others see it')
        until(has_stopped(robot), 'the car stops')
        driver.until(lambda page: not page.known['drive']['held'], 'others see the end')
        return 'no command' not in driver.known['drive']['words']      # the silence was later
    again_if_stalled(loss_stopped)


def test_a_panel_that_was_suspended_does_not_continue_to_drive(driver, control_panel, robot):
    hold = drive_until(driver, drives(robot), 'the car drives')
    with suspended(control_panel.process.pid):
        for _ in range(20):
            drive(driver, hold, speed=170)     # waits in the panel's socket
        wait(0.6)       # longer than the bridge's own timeout, and than a command may be old
        until(has_stopped(robot), "the bridge's own timeout stops the car")
    seen = driver.now
    driver.until(lambda page: page.now > seen + 0.3, 'the panel continues')
    assert 170 not in robot.car.speeds


def test_old_commands_do_not_drive(driver, robot):
    old = driver.now
    driver.until(lambda page: page.now > old + 1, 'a second passes')
    drive(driver, 1, seen=old)
    driver.until(is_refused('too slow'), 'it is refused')
    assert not any(robot.car.speeds)


def test_the_car_stops_when_the_panel_ends(robot):
    with Panel('--control', '--token', TOKEN, name='panel_third') as panel:
        page = Page(panel, TOKEN).settle()
        robot.car.forget()
        drive_until(page, drives(robot), 'the car drives')
        panel.process.send_signal(signal.SIGTERM)
        until(has_stopped(robot), 'the car stops')


class Teleop:
    """Another program that commands the car: this process, 20 times a second.

    Args:
        speed: None: it sends nothing.
    """

    def __init__(self, speed=None):
        self.speed = speed
        self._topic = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=1,
                                      tcp_nodelay=True)
        self._timer = rospy.Timer(rospy.Duration(0.05), self._publish)

    def _publish(self, _event):
        if self.speed is not None:
            self._topic.publish(value=self.speed)

    def is_heard_by(self, *nodes):
        """Whether these nodes are connected."""
        return all(self._topic.impl.has_connection(node) for node in nodes)

    def end(self):
        """Publish no more."""
        self._timer.shutdown()
        self._topic.unregister()


@pytest.fixture
def teleop(driver, control_panel, robot):
    """Another program, which may drive."""
    teleop = Teleop()
    until(lambda: teleop.is_heard_by(NODE, control_panel.node), 'bridge and panel hear it')
    yield teleop
    teleop.end()
    driver.send(stop={'key': 'over'})
    until(has_stopped(robot), 'the car stops')


def test_no_page_drives_while_another_program_does(driver, teleop, robot):
    teleop.speed = 300
    until(drives(robot, 300), 'it drives')
    holds = count(1)

    def is_the_only_one():
        robot.car.forget()
        for hold in islice(holds, 20):
            keep_driving(driver, hold, 1)
        until(lambda: is_refused('/panel_test commands the car')(driver),
              'it is refused, with the reason', doing=lambda: drive(driver, next(holds)),
              every=0.04)
        return set(robot.car.speeds) <= {300}
    again_if_stalled(is_the_only_one)       # for half a second: then the page may drive


def test_a_speed_0_of_another_program_ends_a_hold(driver, teleop, robot):
    hold = drive_until(driver, drives(robot), 'the car drives')
    teleop.speed = 0
    until(lambda: is_refused('/panel_test commands the car')(driver), 'the hold has ended',
          doing=lambda: drive(driver, hold), every=0.04)
    check_that_no_speed_follows(driver, hold, robot, 'the car stops')


def test_stop_is_repeated_against_a_program_that_goes_on_and_says_so(driver, teleop, robot):
    teleop.speed = 300
    until(drives(robot, 300), 'it drives')

    def goes_on():
        robot.car.forget()
        key, since = f'against {next(_KEYS)}', time.monotonic()
        driver.send(stop={'key': key})
        # Only a speed in the first second counts, and a stall may delay all of them.
        until(lambda: driver.calls.get(key, {}).get('outcome') == 'not known'
              or time.monotonic() > since + 3, 'the page says that it goes on')
        answer = driver.calls.get(key, {})
        return answer.get('outcome') == 'not known' and robot.car.speeds.count(0) >= 3 and answer
    assert '/panel_test goes on sending speeds' in again_if_stalled(goes_on)['words']
    teleop.speed = 0


@pytest.mark.parametrize('own_panel', [False, True], ids=['one panel', 'two panels'])
def test_two_pages_do_not_drive_at_once(driver, control_panel, robot, own_panel):
    with contextlib.ExitStack() as stack:
        panel = control_panel
        if own_panel:
            panel = stack.enter_context(Panel('--control', '--token', TOKEN, name='panel_beside'))
        other = stack.enter_context(Page(panel, TOKEN).settle())
        until(lambda: panel.node in publishers_and_subscribers()[1].get(NODE + '/speed', ()),
              'it watches the speeds')
        presses = count(1)
        why = '/panel_control commands the car' if own_panel else 'another page drives'

        def only_one_drives():
            robot.car.forget()
            hold = drive_until(driver, drives(robot), 'the car drives')
            first = next(presses)

            def both():
                drive(driver, hold)
                drive(other, next(presses) if own_panel else first, speed=-90)
            for page in driver, other:
                page.known.pop('refused', None)
            until(lambda: is_refused(why)(other) or 'refused' in driver.known,
                  'the other is refused', doing=both, every=0.04)
            if 'refused' in driver.known:       # this machine stalled, and its hold has ended
                return False
            robot.car.forget()
            for _ in range(20):
                both()
                time.sleep(0.04)
            signs = [speed > 0 for speed in robot.car.speeds if speed]
            return sum(one != next_ for one, next_ in zip(signs, signs[1:])) == 0 \
                and (own_panel or -90 not in robot.car.speeds)
        again_if_stalled(only_one_drives, tries=10)
        hold = drive_until(driver, drives(robot, 130), 'the car drives', 130)
        driver.known.pop('refused', None)
        other.send(seen=0, stop={'key': 'other'})       # however old it is
        until(lambda: 'refused' in driver.known, 'the hold has ended',
              doing=lambda: drive(driver, hold), every=0.04)
        check_that_no_speed_follows(driver, hold, robot, 'STOP on the other stops the car')
        assert own_panel or wait_for_answer(other, 'other')['outcome'] == 'sent'


# -- a master, a bridge or a panel that hangs -------------------------------------------------


def test_pages_and_driving_continue_while_the_master_hangs(driver, control_panel, robot, core):
    with Page(control_panel, TOKEN) as other:
        other.until(lambda page: 'node' in page.known, 'the other page receives updates')
        drive_until(driver, drives(robot), 'the car drives')
        with core.hung():
            other.send(watch=TOPICS + ['serial_msg'])
            wait(0.5)
            continues(other)
            robot.car.forget()
            hold = drive_until(driver, drives(robot), 'the car drives while the master hangs')
            driver.send(release={'hold': hold})
            until(has_stopped(robot), 'the car stops')
            robot.car.forget()
            drive_until(driver, drives(robot), 'the car drives again')
            until(has_stopped(robot), 'the car stops without commands of the page')
        other.until(lambda page: page.known.get('wire', {}).get('frames'), 'frames are received')


def test_publishers_exist_only_while_a_page_is_open(control_panel, robot, core):
    with Page(control_panel, TOKEN) as page:
        until(lambda: publishes(control_panel), 'the panel publishes')
        with core.hung():
            page.close()
            wait(2)
            page = Page(control_panel, TOKEN)
            page.until(lambda page: 'node' in page.known, 'the page receives updates')
        robot.car.forget()
        drive_until(page, drives(robot), 'the car drives')
        page.close()
        until(lambda: not publishes(control_panel), 'the panel publishes no more')


def nothing(_panel):
    pass


def show_wire(panel):
    """Let the panel subscribe to serial_msg."""
    Page(panel, TOKEN, watch=['serial_msg'])
    wait(0.3)


def look_up(panel):
    """Let the panel look up a service."""
    page = Page(panel, TOKEN).settle()
    lift(page, 'key')
    page.until(lambda page: 'key' in page.calls or 'key' in page.refusals,
               'the call is under way, or a stall of this machine made it too old')


@pytest.mark.parametrize('number, action', [
    (signal.SIGINT, nothing), (signal.SIGINT, show_wire), (signal.SIGTERM, look_up)])
def test_a_signal_ends_the_panel_while_the_master_hangs(robot, core, number, action):
    with Panel('--control', '--token', TOKEN, name='panel_hung') as panel:
        page = Page(panel, TOKEN)
        page.until(lambda page: page.known.get('trouble') == '', 'it is registered and subscribes')
        with core.hung():
            action(panel)
            assert panel.end(number) == 0


def test_a_signal_ends_a_panel_that_starts_while_the_master_hangs(core):
    with core.hung(), Panel(name='panel_hung'):
        pass


class PipedPanel:
    """A panel that prints into a pipe. As a context it has to end well with its block."""

    def __init__(self, *arguments):
        self._reads, self._writes = os.pipe()
        self._process = subprocess.Popen(
            [program('panel'), '--port', '0', *arguments, '__name:=panel_piped'],
            stdout=self._writes, stderr=self._writes)
        self.port, self.token = self.read_address()

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        try:
            self._process.send_signal(signal.SIGINT)
            assert self._process.wait(PATIENCE) == 0 or kind
        finally:
            self._process.kill()
            for each in self._reads, self._writes:
                os.close(each)

    def read_address(self):
        """Read until an address has been printed; return its port and its token."""
        found = until(lambda: re.search(rb'http://[^/]+:([0-9]+)/#?(\S*)',
                                        os.read(self._reads, 1000)), 'it prints an address')
        return int(found.group(1)), found.group(2).decode()

    def fill_pipe(self):
        """Nothing more can be printed from now on."""
        os.set_blocking(self._writes, False)
        for size in 1000, 1:
            with contextlib.suppress(BlockingIOError):
                while True:
                    os.write(self._writes, bytes(size))
        os.set_blocking(self._writes, True)     # the panel's output shares this setting


def test_a_terminal_that_reads_nothing_does_not_delay_pages(robot):
    with PipedPanel() as panel:
        page = Page(panel)
        page.until(lambda page: page.known.get('trouble') == '', 'it is a node and logs')
        panel.fill_pipe()
        assert Page(panel, origin='http://evil.example').status == 403     # is logged
        continues(page)


@pytest.mark.parametrize('by', ['master', 'bridge'])
def test_a_call_delayed_by_the_master_or_the_bridge_moves_nothing(driver, robot, core, by):
    def delayed():
        key = f'delayed by the {by} {next(_KEYS)}'
        wait(0.6)       # or a second try may be a double click
        with core.hung() if by == 'master' else suspended(robot.bridge.process.pid):
            lift(driver, key)
            driver.until(lambda page: key in page.calls or key in page.refusals,
                         'the call is under way')
            if key in driver.refusals:
                return False        # this machine stalled
            wait(2.5)
            waits = not driver.calls[key].get('outcome')
        answer = wait_for_answer(driver, key)
        assert answer['outcome'] == 'refused' and 'nothing was sent' in answer['words']
        return waits or by == 'bridge'      # the panel waits 3 s for the master
    again_if_stalled(delayed)

    def moved():        # unless a stall dropped the request or the reply
        return driver.call('~lift', direction=0, distance=17)['outcome'] == 'done'
    again_if_stalled(moved)
    assert {request.data for request in robot.lift_requests} == {bytes((0, 17))}


def test_a_call_delayed_by_the_panel_moves_nothing(driver, control_panel, robot):
    with suspended(control_panel.process.pid):
        lift(driver, 'late')
        driver.send(led={'key': 'old', 'text': 'old'})
        wait(2.5)
    wait_until_refused(driver, 'late', 'old')
    assert not robot.lift_requests
    assert arduino.encode(arduino.LedCommand('old')) not in robot.car.raw_commands
