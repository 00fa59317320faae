"""The panel, tested with clients without a browser: access, limits, subscriptions and commands."""
import contextlib
import os
import signal
import socket
import subprocess
import time
from itertools import count

import pytest
from boards import PACKAGE, Master, again_if_stalled, program, settle, until
from panel_helpers import (KEPT_BACK, NODE, TOKEN, Page, Panel, publishers_and_subscribers,
                           subscribed)

from serial_communication.boards.bus import wire as bus

TOPICS = ['~imu', '~voltage', '~environment', 'mcu/range_1', '~nothing']


@pytest.fixture
def page(panel):
    with Page(panel, watch=TOPICS) as page:
        yield page


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


def test_on_loopback_a_name_of_this_machine_is_refused(panel, control_panel):
    """A proxy or a tunnel that others reach is behind it."""
    for each in panel, control_panel:
        for host in socket.gethostname(), '192.168.1.7', 'evil.example':
            status, _headers, text = each.get('/', Host=f'{host}:{each.port}')
            assert status == 403 and 'is not a name of this machine on loopback' in text
            assert Page(each, host=f'{host}:{each.port}').status == 403
        assert each.get('/', Host='127.0.0.1')[0] == each.get('/', Host='localhost')[0] == 200
        each.wait_for('is not a name of this machine')


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


_REFUSED = bus.Reply(bus.ERROR, b'\2\x80')


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


def test_the_car_stops_when_the_panel_ends(robot):
    with Panel('--control', '--token', TOKEN, name='panel_third') as panel:
        page = Page(panel, TOKEN).settle()
        robot.car.forget()
        drive_until(page, drives(robot), 'the car drives')
        panel.process.send_signal(signal.SIGTERM)
        until(has_stopped(robot), 'the car stops')


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


# -- a master, a bridge or a panel that hangs -------------------------------------------------
