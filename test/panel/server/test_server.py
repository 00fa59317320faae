"""The panel, tested with clients without a browser: access, limits, subscriptions and commands."""
import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import threading
import time
from itertools import count

import pytest
import rospy
from boards import PACKAGE, PATIENCE, Master, again_if_stalled, program, settle, until
from panel_helpers import (KEPT_BACK, NODE, TOKEN, Page, Panel, publishers_and_subscribers,
                           subscribed, suspended)

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.msg import SpeedPWMCommand

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
    until(lambda: not page.known.get('drives') or page.closed, 'no page drives')


def publishes(panel):
    """Whether the master knows it as a publisher of speeds."""
    return panel.node in publishers_and_subscribers()[0].get(NODE + '/speed', ())


# -- the command line -------------------------------------------------------------------------


def run(*arguments, environment=None):
    return subprocess.run([program('panel'), *arguments], text=True, timeout=60,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          env={**os.environ, 'ROS_MASTER_URI': 'http://127.0.0.1:1',
                               **(environment or {})})


@pytest.mark.usefixtures('two_pages')       # so that their 5 s begin
def test_a_port_in_use_ends_with_one_line_that_names_its_holder_and_a_free_port(panel):
    done = run('--port', str(panel.port))
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1
    found = re.fullmatch(r'panel: cannot listen on 127.0.0.1 port (\d+): Address already in use, '
                         r'by panel \(pid (\d+)\); free: --port (\d+)\n', done.stderr)
    assert found.group(1, 2) == (str(panel.port), str(panel.process.pid))
    assert int(found.group(3)) > panel.port


def test_at_a_new_master_the_panel_starts_again_with_its_port_and_token():
    master = Master().start()
    try:
        with Panel('--control', name='panel_again',
                   environment={'ROS_MASTER_URI': master.uri}) as panel:
            def is_known():     # rospy registers this service last
                return master.server.is_online() and '/panel_again/set_logger_level' in str(
                    master.server.getSystemState())
            until(is_known, 'it is registered')
            master.end()
            assert panel.exchange(panel.token)[0] == 200
            master.start()
            until(is_known, 'it is registered again')

            def lets_in():
                with contextlib.suppress(OSError):      # it may not listen again yet
                    return panel.exchange(panel.token)[0] == 200
            until(lets_in, 'the token is the same')
            with open(f'/proc/{panel.process.pid}/cmdline') as command_line:
                assert panel.token not in command_line.read()
    finally:
        master.end()


def test_without_a_master_the_panel_serves_pages_that_say_so():
    with Panel(environment={'ROS_MASTER_URI': 'http://127.0.0.1:1'}) as panel, Page(panel) as page:
        panel.wait_for('panel: waiting for the ROS master at http://127.0.0.1:1; start one with')
        page.until(lambda page: 'no answer from the ROS master' in page.known.get('trouble', ''),
                   'the page shows it')


def test_a_second_panel_of_the_same_name_ends_and_the_first_continues(panel):
    second = Panel(name='panel_read_only')
    assert second.process.wait(PATIENCE) == 3
    second.wait_for('another node is named /panel_read_only')
    second.wait_for('or name this one: __name:=panel_read_only_2')
    assert 'Traceback' not in second.output()
    with Page(panel, watch=TOPICS) as page:
        page.until(lambda page: '~imu' in page.samples, 'the first continues')


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
            page.settle().call('~stop', data=False)
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
def test_without_a_status_the_words_say_that_an_outcome_is_not_known(driver, robot, name):
    answered = threading.Event()

    def late(request):
        answered.wait(PATIENCE)
        return robot.bus.usual(request)
    robot.bus.script.append(late)
    try:
        answer = driver.call(name)
    finally:
        answered.set()
    assert answer['outcome'] == 'failed'
    assert ('no reply within 0.3 s: it is not known whether this was executed; '
            'check the robot before you repeat it') in answer['words']


_REFUSED = bus.Reply(bus.ERROR, b'\2\x80')
_WEIGHT = bus.Reply(bus.OK, bytes.fromhex('d204 0000 b841'))


def test_a_reply_is_shown_with_its_outcome_and_its_fields_if_it_is_done(driver, robot):
    for name in '~weigh', '~beep', '~dock':
        answer = call_until_known(driver, robot, name, _REFUSED)
        assert (answer['outcome'], answer['reply']) == (
            'refused' if name == '~weigh' else 'failed', []), name
        assert 'the board refused: 0x8002: the operation failed' in answer['words']
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
    drive_until(driver, drives(robot), 'the car drives')
    driver.until(lambda page: not page.known['drives'], 'the hold ends')
    until(has_stopped(robot), 'the car stops')


def test_a_lost_connection_stops_the_car(driver, control_panel, robot):
    with Page(control_panel, TOKEN).settle() as lost:
        drive_until(lost, lambda: drives(robot)() and driver.known['drives'],
                    'the car drives, and others see it')
    driver.until(lambda page: not page.known['drives'], 'others see the end')
    until(has_stopped(robot), 'the car stops')


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


def test_the_car_stops_when_the_panel_ends(robot):
    with Panel('--control', '--token', TOKEN, name='panel_third') as panel:
        page = Page(panel, TOKEN).settle()
        robot.car.forget()
        drive_until(page, drives(robot), 'the car drives')
        panel.process.send_signal(signal.SIGTERM)
        until(has_stopped(robot), 'the car stops')


def test_two_pages_do_not_drive_at_once(driver, control_panel, robot):
    with Page(control_panel, TOKEN).settle() as other:
        presses = count(1)

        def only_one_drives():
            robot.car.forget()
            hold, press = drive_until(driver, drives(robot), 'the car drives'), next(presses)
            for page in driver, other:
                page.known.pop('refused', None)

            def both():
                drive(driver, hold)
                drive(other, press, speed=-90)
            until(lambda: is_refused('another page drives')(other) or 'refused' in driver.known,
                  'the other is refused', doing=both, every=0.04)
            return 'refused' not in driver.known    # this machine stalled, and its hold has ended
        again_if_stalled(only_one_drives)
    assert -90 not in robot.car.speeds


# -- STOP -------------------------------------------------------------------------------------


def shows_stop(page):
    """Whether the latest status of any link has it."""
    return any(link.get('values', {}).get('condition') == 'stopped'
               for link in page.known.get('links', {}).values())


def test_stop_holds_for_every_page_until_it_is_released(driver, control_panel, page, robot):
    with Page(control_panel, TOKEN).settle() as other:
        hold = drive_until(driver, drives(robot), 'the car drives')
        key = f'stop {next(_KEYS)}'
        other.send(seen=0, stop={'key': key})       # however old it is
        assert wait_for_answer(other, key)['outcome'] == 'done'
        check_that_no_speed_follows(driver, hold, robot, 'the car stops')
        for each in driver, other, page:            # also one that only looks
            each.until(shows_stop, 'the page shows it')
        keep_driving(driver, hold + 1)              # a new press
        assert robot.car.speeds[-1] == 0
        driver.call('~stop', data=False)
        drive_until(driver, lambda: robot.car.speeds[-1] == 130, 'the car drives again', 130)
        page.until(lambda page: not shows_stop(page), 'it holds no more')


def test_a_stop_that_the_bridge_does_not_answer_sends_speed_0(driver, robot):
    received, key = [], f'stop {next(_KEYS)}'
    topic = rospy.Subscriber(NODE + '/speed', SpeedPWMCommand,
                             lambda message: received.append(message.value))
    until(topic.get_num_connections, 'the speeds of the panel are received')
    with suspended(robot.bridge.process.pid):
        driver.send(stop={'key': key})
        until(lambda: received, 'a speed is sent')
    wait_for_answer(driver, key)
    topic.unregister()
    driver.call('~stop', data=False)
    assert set(received) == {0}


# -- a master, a bridge or a panel that hangs -------------------------------------------------


def test_a_call_delayed_by_the_panel_moves_nothing(driver, control_panel, robot):
    with suspended(control_panel.process.pid):
        lift(driver, 'late')
        driver.send(led={'key': 'old', 'text': 'old'})
        wait(2.5)
    wait_until_refused(driver, 'late', 'old')
    assert not robot.lift_requests
    assert arduino.encode(arduino.LedCommand('old')) not in robot.car.raw_commands
