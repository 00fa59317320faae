"""The server, seen by programs that play the browser: who is let in, what costs what, and what
moves the robot."""
import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import threading
import time
import types

import pytest
import rosgraph
import rospy
from boards import PATIENCE, program, ranges, until
from panel_stage import (NODE, TOKEN, Page, Panel, free_port, publishers_and_subscribers,
                         subscribed)

from std_msgs.msg import String

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.msg import SerialMsg

LOOKS = ['~imu', '~voltage', '~environment', 'mcu/range_1', '~nothing']


@pytest.fixture
def page(panel):
    page = Page(panel, watch=LOOKS)
    yield page
    page.close()


@pytest.fixture(scope='module')
def two_pages(panel):
    """One that takes nothing, and one that does: what becomes of them takes 5 s, in which other
    tests run."""
    slow, other = Page(panel, acknowledges=False), Page(panel)
    yield slow, other
    other.close()


@pytest.fixture
def driver(controls, robot):
    """A page that may drive, and whose commands the bridge hears."""
    page = Page(controls, TOKEN)
    page.until(lambda page: 'node' in page.known, 'the panel speaks')
    until(lambda: robot.car.connected, 'the car is there')
    until(lambda: controls.node in publishers_and_subscribers()[0].get(NODE + '/speed', ()),
          'the panel publishes speeds')
    robot.car.forget()
    yield page
    page.close()
    until(lambda: not page.known.get('drive', {}).get('held') or page.closed, 'nobody drives')


# -- the command line -------------------------------------------------------------------------


def run(*arguments):
    return subprocess.run([program('panel'), *arguments], text=True, timeout=60,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          env={**os.environ, 'ROS_MASTER_URI': 'http://127.0.0.1:1'})


def test_help():
    done = run('--help')
    assert done.returncode == 0 and done.stdout.startswith('usage: panel') and not done.stderr
    for word in ('--port', '--bind', '--control', '--token', '--node'):
        assert word in done.stdout


@pytest.mark.parametrize('arguments, words', [
    (['--port', '99999'], "'99999', may be a number from 0 to 65535"),
    (['--port', 'x'], "'x', may be a number"), (['--fast'], 'unrecognized arguments: --fast'),
    (['--token', 'short'], '5 characters, may be at least 12'),
    (['--token', 'with a space in it'], 'may be at least 12 of A-Z')])
def test_wrong_arguments(arguments, words):
    done = run(*arguments)
    assert done.returncode == 2 and words in done.stderr and not done.stdout


@pytest.mark.usefixtures('two_pages')       # so that their time begins
def test_an_address_that_cannot_be_had(panel):
    done = run('--port', str(panel.port))
    assert done.returncode == 1
    assert done.stderr.startswith('panel: cannot listen on 127.0.0.1 port') \
        and len(done.stderr.splitlines()) == 1


def test_without_a_master_it_says_so_serves_and_ends():
    panel = Panel(environment={'ROS_MASTER_URI': 'http://127.0.0.1:1'})
    panel.wait_for('panel: waiting for the ROS master at http://127.0.0.1:1; start one with')
    page = Page(panel)
    page.until(lambda page: 'no answer from the ROS master' in page.known.get('trouble', ''),
               'the page is told')
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
    'begin(*arguments, **keywords); rospy.core._in_shutdown = True'    # its hooks have been run
], ids=['before', 'after'])
def test_a_name_that_is_taken_as_it_registers_ends_the_panel(meanwhile):
    done = subprocess.run(['/usr/bin/python3', '-c', _NAME_TAKEN % meanwhile], text=True,
                          timeout=30, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert done.returncode == 1, done.stderr
    assert done.stderr.count('ROS has ended this node') == 1 and 'Traceback' not in done.stderr


def test_a_second_panel_of_the_same_name_leaves_the_first_alone(panel):
    second = Panel(name='panel_looks')
    assert second.process.wait(30) == 3
    second.wait_for('another node is named /panel_looks')
    assert 'Traceback' not in second.output()
    page = Page(panel, watch=LOOKS)
    page.until(lambda page: '~imu' in page.rows, 'the first one lives on')
    page.close()


def test_a_name_that_somebody_else_takes_ends_the_panel(robot):
    panel = Panel(name='panel_taken')
    until(lambda: rosnode_is_known('/panel_taken'), 'it is registered')
    rosgraph.Master('/panel_taken').registerSubscriber(
        '/chatter', 'std_msgs/String', 'http://localhost:1/')
    assert panel.process.wait(30) == 1
    panel.wait_for('panel: ROS has ended this node')


def rosnode_is_known(name):
    try:
        return rosgraph.Master('/panel_test').lookupNode(name)
    except rosgraph.MasterError:
        return False


# -- who is let in ----------------------------------------------------------------------------


def test_the_page_loads_nothing_from_elsewhere_and_nothing_inline(panel):
    status, headers, text = panel.get('/')
    assert status == 200 and '<title>' in text
    policy = headers['Content-Security-Policy']
    for rule in ("default-src 'none'", "script-src 'self'", "frame-ancestors 'none'",
                 "base-uri 'none'", "require-trusted-types-for 'script'"):
        assert rule in policy
    assert 'unsafe' not in policy and '*' not in policy
    assert headers['X-Content-Type-Options'] == 'nosniff'
    assert headers['Referrer-Policy'] == 'no-referrer'


@pytest.mark.parametrize('path', ['/../cli.py', '/%2e%2e/cli.py', '/cards/../../cli.py',
                                  '/nothing.js', '/cards/'])
def test_no_other_files(panel, path):
    assert panel.get(path)[0] in (403, 404)


def test_foreign_host(panel):
    status, _headers, text = panel.get('/', Host='evil.example')
    assert status == 403 and 'is no name of this machine' in text
    assert Page(panel, host='evil.example:80').status == 403
    panel.wait_for('is no name of this machine')


@pytest.mark.parametrize('origin', ['http://evil.example', 'null', None])
def test_foreign_origin(panel, origin):
    assert Page(panel, origin=origin).status == 403


def test_foreign_origin_of_a_file(panel):
    assert panel.get('/app.js', Origin='http://evil.example')[0] == 403
    assert panel.get('/app.js', Origin=f'http://127.0.0.1:{panel.port}')[0] == 200


def test_token(controls):
    assert controls.url.endswith(f'?token={TOKEN}')
    status, headers, text = controls.get('/')
    assert status == 401 and 'with its token' in text and 'Set-Cookie' not in headers
    assert controls.get('/app.js')[0] == 401
    assert controls.get('/?token=not-the-right-one')[0] == 401
    assert Page(controls).status == 401
    assert Page(controls, 'not-the-right-one').status == 401
    status, headers, _text = controls.get(f'/?token={TOKEN}')
    cookie = headers['Set-Cookie']
    assert status == 200 and 'HttpOnly' in cookie and 'SameSite=Strict' in cookie
    assert controls.get('/app.js', Cookie=cookie.split(';')[0])[0] == 200
    page = Page(controls, TOKEN)
    assert page.status == 101
    page.close()
    # Said once, as the address; not with any request.
    assert controls.output().count(TOKEN) == 1


@pytest.mark.parametrize('arguments', [['--control'], ['--bind', '0.0.0.0']])
def test_what_may_do_harm_gets_a_token_of_its_own(arguments):
    one, other = Panel(*arguments, name='one'), Panel(*arguments, name='other')
    assert len(one.token) >= 20 and one.token != other.token
    assert one.get('/')[0] == 401
    assert one.end() == other.end() == 0


def test_a_page_that_asks_too_often_or_talks_nonsense_is_dropped(panel):
    for message, why in ((b'{', 'says what no page says'), (b'[1]', 'says what no page says'),
                         (b'{"watch": 5}', 'says what no page says'), (b'{"drive": 1}', 'no page'),
                         (b'{"seen": NaN}', 'no page'), (b'{"seen": 1e999}', 'no page'),
                         (b'{"release": {"hold": 1e999}}', 'no page'),
                         (b'{"release": {"hold": -Infinity}}', 'no page'),
                         (b'{"seen": 1%s, "led": {"text": ""}}' % bytes(400).replace(
                             b'\0', b'0'), 'no page'),
                         (b'[' * 4000, 'no page')):
        page = Page(panel)
        page.write(message)
        until(lambda: why in page.closed, f'{message} is refused')
    page = Page(panel)
    for _ in range(400):
        page.write(b'{"seen": 0}')
    until(lambda: 'says too much' in page.closed, 'it is dropped')
    page = Page(panel)
    page.write(json.dumps({'watch': ['x' * 5000]}).encode())
    until(lambda: page.closed, 'a message that is too long ends it')


@pytest.fixture
def bystander(panel):
    """A page to which nothing of what another one does may happen."""
    page = Page(panel, watch=LOOKS)
    page.until(lambda page: '~imu' in page.rows, 'it is told what is new')
    yield page
    assert not page.closed
    seen = page.now
    page.until(lambda page: page.now > seen + 0.5, 'it is told what is new')
    page.close()


MASK = bytes(4)


@pytest.mark.parametrize('frame', [
    b'\x89\x80' + MASK, b'\x89\xfd' + MASK + bytes(125), b'\x8a\x80' + MASK, b'\x00\x80' + MASK],
    ids=['pings', 'long pings', 'pongs', 'fragments'])
@pytest.mark.parametrize('reads', [True, False])
def test_a_flood_of_frames_that_are_no_messages_is_dropped(panel, bystander, frame, reads):
    page = Page(panel, reads=reads)
    if frame[0] == 0:
        page.flood(b'\x01\x80' + MASK)         # a message begins
    ended = threading.Event()

    def flood():
        while not ended.is_set():
            page.flood(frame * 1000)
    seen = bystander.now
    thread = threading.Thread(target=flood, daemon=True)
    thread.start()
    try:
        bystander.until(lambda page: page.now > seen + 1, 'others are told what is new')
        if reads:
            until(lambda: page.closed, 'it is dropped')
            assert 'too much' in page.closed or page.closed == 'gone'
    finally:
        ended.set()
        page.close()
        thread.join()


def test_a_ping_is_answered(page):
    page.write(b'x', 0x89)
    page.until(lambda page: page.pongs, 'the answer comes')


@pytest.mark.parametrize('says', [
    {}, {'seen': 1e18}], ids=['nothing', 'that it has seen everything'])
def test_a_page_that_reads_nothing_is_dropped_whatever_it_says(robot, says):
    panel = Panel(name='panel_unread')
    page = Page(panel, watch=[*LOOKS, 'serial_msg'], reads=False)
    until(lambda: 'dropped a page at 127.0.0.1: it does not take' in panel.output(),
          'it is dropped', seconds=60,
          doing=lambda: says and page.say(**says), every=0.1)
    page.close()
    assert panel.end() == 0


def test_idle_connections_keep_nobody_out(robot):
    panel = Panel(name='panel_crowded')
    before = Page(panel, watch=LOOKS)
    before.until(lambda page: '~imu' in page.rows, 'numbers come')
    resource.prlimit(panel.process.pid, resource.RLIMIT_NOFILE, (160, 160))
    idle = [socket.create_connection(('127.0.0.1', panel.port)) for _ in range(300)]
    later = Page(panel, watch=LOOKS)
    later.until(lambda page: '~imu' in page.rows, 'another page is served')
    assert panel.get('/app.js')[0] == 200
    seen = before.now
    before.until(lambda page: page.now > seen + 0.5, 'the first is told what is new')
    assert not before.closed
    for each in idle:
        each.close()
    assert panel.end() == 0
    assert 'Too many open files' not in panel.output()


def another_page(panel, pages):
    pages.append(Page(panel, reads=False))
    return pages[-1].status == 101


def test_pages_that_are_dropped_and_stay_keep_nobody_out(panel, bystander):
    pages = []
    for _ in range(80):
        until(lambda: another_page(panel, pages), 'there is room')
        pages[-1].write(b'{')
    later = Page(panel, watch=LOOKS)
    later.until(lambda page: '~imu' in page.rows, 'another page is served')
    for page in [*pages, later]:
        page.close()


def test_a_slow_page_is_dropped_and_the_others_are_not(panel, two_pages):
    slow, other = two_pages
    until(lambda: 'does not take' in slow.closed, 'the slow one is dropped')
    assert not other.closed
    panel.wait_for('it does not take what is sent to it')
    other.close()


def test_only_so_many_pages(panel):
    pages = [Page(panel) for _ in range(16)]
    try:
        assert {page.status for page in pages} == {101}
        assert Page(panel).status == 503
    finally:
        for page in pages:
            page.close()
    until(lambda: retry_page(panel), 'there is room again')


def retry_page(panel):
    page = Page(panel)
    page.close()
    return page.status == 101


# -- what it costs, and what it tells ---------------------------------------------------------


def test_no_browser_no_subscription(panel):
    until(lambda: not subscribed(panel.node), 'nothing is subscribed to')
    page = Page(panel, watch=LOOKS)
    wanted = {NODE + '/imu', NODE + '/voltage', NODE + '/environment', '/mcu/range_1',
              '/diagnostics', '/rosout_agg'}
    until(lambda: subscribed(panel.node) == wanted, 'the topics that the page shows, and no other')
    page.say(watch=LOOKS + ['serial_msg'])
    until(lambda: subscribed(panel.node) == wanted | {'/serial_msg'}, 'the wire is looked at')
    page.until(lambda page: page.known.get('wire', {}).get('frames'), 'frames come')
    page.say(watch=LOOKS)
    until(lambda: subscribed(panel.node) == wanted, 'the wire is looked at no longer')
    page.close()
    until(lambda: not subscribed(panel.node), 'nothing is subscribed to')


def test_values_and_links(page, robot):
    robot.others[0] = arduino.Voltage(6.25)
    page.until(lambda page: page.rows.get('~voltage', {}).get('voltage') == 6.25, 'the voltage')
    robot.others[0] = arduino.Voltage(7.4)
    page.until(lambda page: page.rows.get('~imu', {}).get('acceleration z') is not None, 'the IMU')
    assert page.rows['~imu']['acceleration z'] == pytest.approx(9.81, abs=1e-3)
    page.until(lambda page: page.rows.get('~environment', {}).get('smoke') == 350, 'the air')
    page.until(lambda page: page.rows.get('mcu/range_1', {}).get('range') == 0.47, 'a range')
    page.until(lambda page: {'bus', 'arduino', 'mcu'} <= set(page.known.get('links', {})),
               'all links')
    assert page.known['links']['arduino']['values']['port'] == robot.lines['arduino'].near
    assert page.known['node'] == NODE and page.known['trouble'] == ''


def test_a_page_that_is_opened_later_gets_the_history(page, panel):
    page.until(lambda page: '~environment' in page.rows, 'the air')
    later = Page(panel, watch=LOOKS)
    later.until(lambda page: page.updates, 'the first update')
    first = later.updates[0]
    assert '~environment' in first['topics'] and 'smoke' in first['topics'][
        '~environment']['fields'][0]
    later.close()


def test_what_a_range_may_read_beside_numbers_is_json(page, robot):
    for millimetres, word in ((65535, 'NaN'), (5000, 'Infinity'), (10, '-Infinity')):
        robot.ranges = ranges(millimetres)
        page.until(lambda page: page.rows.get('mcu/range_1', {}).get('range') == word,
                   f'{word} comes')
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


def test_the_board_of_another_package_is_known_and_its_frames_are_explained(core, tmp_path):
    """This process plays the bridge."""
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
        until(lambda: page.known.get('wire', {}).get('frames'), 'frames come', every=0.1,
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


def test_a_panel_that_only_looks_takes_no_commands(page, robot):
    before = len(robot.lifts)
    page.say(call={'key': 'a', 'name': '~lift', 'arguments': {'direction': 0, 'distance': 5}})
    page.until(lambda page: page.known.get('refused'), 'it is refused')
    assert 'only looks' in page.known['refused']['words'] and len(robot.lifts) == before
    assert 'controls' not in page.known
    assert not any('/panel_looks' in publishers_and_subscribers()[0].get(NODE + name, ())
                   for name in ('/speed', '/steering', '/led'))


def lift(page, key, distance=5):
    page.say(call={'key': key, 'name': '~lift',
                   'arguments': {'direction': 0, 'distance': distance}})


def test_a_call_and_its_answer(driver, robot):
    robot.bus.forget()
    lift(driver, 'one', 17)
    driver.until(lambda page: page.calls.get('one', {}).get('outcome'), 'the answer')
    assert driver.calls['one']['outcome'] == 'done' and 'lift up 17 mm' in driver.calls['one'][
        'words']
    assert [request.data for request in robot.lifts] == [bytes((0, 17))]


def test_a_double_click_moves_once(driver, robot):
    robot.bus.forget()
    for key in ('first', 'second', 'third'):
        lift(driver, key)
    driver.until(lambda page: page.calls.get('first', {}).get('outcome'), 'the answer')
    lift(driver, 'fourth')     # at once after the answer
    driver.until(lambda page: page.known.get('refused', {}).get('key') == 'fourth', 'refused')
    assert len(robot.lifts) == 1
    assert not {'second', 'third', 'fourth'} & set(driver.calls)


def test_not_known_is_told_as_that(driver, robot):
    until(lambda: time.monotonic() - driver.now < 1, 'the page is up to date')
    robot.bus.script.append(b'')
    driver.until(lambda page: try_lift(page, 'lost'), 'the call is taken')
    driver.until(lambda page: page.calls['lost'].get('outcome'), 'the answer')
    assert driver.calls['lost']['outcome'] == 'not known'


def call_own(page, name):
    """Call a function of the configuration, and wait for its answer."""
    page.until(lambda page: name in page.known.get('controls', {}).get('services', ()), name)
    key = f'{name} at {time.monotonic()}'        # a page is told of calls before it, too
    page.say(call={'key': key, 'name': name, 'arguments': {}})
    page.until(lambda page: page.calls.get(key, {}).get('outcome'), 'the answer')
    return page.calls[key]


@pytest.mark.parametrize('name', ['~beep', '~dock'])
def test_what_was_executed_and_answered_too_late_is_told_as_not_known(driver, robot, name):
    """The response's type has no status."""
    answered = threading.Event()

    def late(request):
        answered.wait(PATIENCE)
        return robot.bus.usual(request)
    robot.bus.script.append(late)
    try:
        call = call_own(driver, name)
    finally:
        answered.set()
    assert call['outcome'] == 'not known'
    assert call['words'] == ('no reply within 0.3 s: it is not known whether this was executed; '
                             'look before you repeat it')


@pytest.mark.parametrize('name', ['~beep', '~dock'])
def test_what_the_board_refused_is_told_as_that(driver, robot, name):
    robot.bus.script.append(bus.Reply(bus.ERROR, b'\2\x80'))
    call = call_own(driver, name)
    assert (call['outcome'], call['words']) == (
        'refused', 'the board refused: 0x8002: the operation failed')


def test_a_bridge_that_dies_in_the_middle_of_a_call_leaves_it_not_known(driver, robot):
    until(lambda: time.monotonic() - driver.now < 1, 'the page is up to date')
    robot.bus.script.append(lambda request: robot.bridge.process.kill() or b'')
    call = call_own(driver, '~beep')
    robot.start_bridge()
    assert call['outcome'] == 'not known' and 'look before you repeat it' in call['words']


def try_lift(page, key):
    """A call that a page of this test may still be too early for."""
    if key not in page.calls:
        lift(page, key)
        time.sleep(0.2)
    return key in page.calls


@pytest.mark.parametrize('name, arguments, words', [
    ('~lift', {'direction': 0}, 'takes direction, distance'),
    ('~lift', {'direction': 0, 'distance': 300}, '~lift'),
    ('~lift', {'direction': 0, 'distance': 'x'}, '~lift'),
    ('~get_loggers', {}, 'no service'), ('/rosout/get_loggers', {}, 'no service')])
def test_calls_that_are_none(driver, robot, name, arguments, words):
    robot.bus.forget()
    driver.say(call={'key': 'wrong', 'name': name, 'arguments': arguments})
    driver.until(lambda page: page.known.get('refused', {}).get('key') == 'wrong', 'refused')
    assert words in driver.known['refused']['words'] and not robot.lifts


_SERVICE = """
from std_msgs.msg import Float32
from std_srvs.srv import SetBoolResponse

class Set:
    _type, _md5sum = 'floats/Set', '0' * 32
    _request_class, _response_class = Float32, SetBoolResponse
"""


@pytest.fixture
def floats(core, tmp_path):
    """A panel of a bridge, which this process plays, with a service that takes a number."""
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
    ('1' + '0' * 400, True)], ids=['nan', 'overflow', 'infinity', 'beyond float32', 'an integer'])
def test_a_number_that_is_none_silences_nobody(floats, number, is_json):
    page, other = Page(floats, TOKEN), Page(floats, TOKEN)
    page.until(lambda page: '~set' in page.known.get('controls', {}).get('services', ()),
               'the service is offered')
    page.write(b'{"seen": %f, "call": {"key": "odd", "name": "~set", "arguments": {"data": %s}}}'
               % (page.now, number.encode()))
    if is_json:
        page.until(lambda page: page.known.get('refused', {}).get('key') == 'odd', 'refused')
        assert not page.closed
    else:
        until(lambda: 'no page says' in page.closed, 'it is dropped')
    seen = other.now
    other.until(lambda page: page.now > seen + 0.5, 'others are told what is new')
    assert not other.closed and 'odd' not in other.calls
    page.close()
    other.close()


def test_led(driver, robot):
    driver.until(lambda page: send_led(page, robot), 'the car shows it')
    driver.say(led={'key': 'long', 'text': 'x' * 31})
    driver.until(lambda page: page.known.get('refused', {}).get('key') == 'long', 'refused')


def send_led(page, robot):
    page.say(led={'key': 'led', 'text': 'left'})
    time.sleep(0.05)
    return arduino.encode(arduino.LedCommand('left')) in robot.car.commands


# -- driving ----------------------------------------------------------------------------------


def drive(page, hold, speed=150, seen=None, steering=1600):
    page.say(drive={'key': 'drive', 'hold': hold, 'seen': page.now if seen is None else seen,
                    'speed': speed, 'steering': steering})


def drive_until(page, condition, what, speed=150):
    """Hold until something is so, ten and more times a second; the number of the hold.

    Where the machine stands still for too long meanwhile, the hold ends; then another.
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


def stands(robot):
    """Whether the last that the car was told is to stand, and that it did drive before."""
    return lambda: robot.car.speeds and robot.car.speeds[-1] == 0


def test_release_stops(driver, robot):
    hold = drive_until(driver, drives(robot), 'the car drives')
    driver.say(release={'hold': hold})
    until(stands(robot), 'the car stands')
    count = len(robot.car.speeds)
    drive(driver, hold)
    driver.until(lambda page: 'press again' in page.known.get('refused', {}).get('words', ''),
                 'a command of the hold that has ended is refused')
    assert robot.car.speeds[count:] in ([], [0])


def test_silence_stops(driver, robot):
    drive_until(driver, drives(robot), 'the car drives')
    until(stands(robot), 'the car stands')
    driver.until(lambda page: page.known['drive'] == {
        'held': False, 'words': 'the browser fell silent: stopped'}, 'the page is told')
    # The panel said so, long before the bridge's own timeout of 0.5 s had to.
    assert robot.car.frames[-1].stamp


def test_a_lost_connection_stops(driver, robot):
    drive_until(driver, drives(robot), 'the car drives')
    driver.close()
    until(stands(robot), 'the car stands')


def test_old_commands_do_not_drive(driver, robot):
    old = driver.now
    driver.until(lambda page: page.now > old + 1, 'a second passes')
    for _ in range(5):
        drive(driver, 1, seen=old)
    driver.until(lambda page: any('too slow' in update.get('refused', {}).get('words', '')
                                  for update in list(page.updates)), 'they are refused')
    driver.holds = 1
    drive_until(driver, drives(robot, 120), 'what is fresh drives', speed=120)
    assert 150 not in robot.car.speeds


def test_a_panel_that_was_suspended_does_not_drive_on(driver, controls, robot):
    hold = drive_until(driver, drives(robot), 'the car drives')
    os.kill(controls.process.pid, signal.SIGSTOP)
    try:
        for _ in range(20):
            drive(driver, hold, speed=170)     # waits in the panel's socket
        until(stands(robot), "the bridge's own timeout stops the car")
        robot.car.forget()
    finally:
        os.kill(controls.process.pid, signal.SIGCONT)
    seen = driver.now
    driver.until(lambda page: page.now > seen + 0.3, 'the panel lives on')
    assert not [speed for speed in robot.car.speeds if speed]


def test_two_pages_do_not_drive_at_once(driver, controls, robot):
    other = Page(controls, TOKEN)
    other.until(lambda page: page.now, 'the other page is there')
    hold = drive_until(driver, drives(robot), 'the car drives')

    def both():
        drive(driver, hold)
        drive(other, 1, speed=-90)
    until(lambda: 'another browser drives' in other.known.get('refused', {}).get('words', ''),
          'the other is refused', doing=both, every=0.04)
    assert -90 not in robot.car.speeds
    other.close()


def test_the_panels_end_stops(robot):
    panel = Panel('--control', '--token', TOKEN, name='panel_third')
    page = Page(panel, TOKEN)
    page.until(lambda page: page.now, 'the page is there')
    robot.car.forget()
    drive_until(page, drives(robot), 'the car drives')
    panel.process.send_signal(signal.SIGTERM)
    until(stands(robot), 'the car stands')
    assert panel.end() == 0


# -- a master, a bridge or a panel that hangs -------------------------------------------------


def wait(seconds):
    began = time.monotonic()
    until(lambda: time.monotonic() - began > seconds, 'the time has passed')


def test_a_master_that_hangs_holds_up_neither_pages_nor_the_car(driver, controls, robot, core):
    other = Page(controls, TOKEN)
    other.until(lambda page: 'node' in page.known, 'the other page is there')
    hold = drive_until(driver, drives(robot), 'the car drives')
    with core.hung():
        other.say(watch=LOOKS + ['serial_msg'])
        wait(0.5)
        seen = other.now
        other.until(lambda page: page.now > seen + 0.5, 'pages are told what is new')
        robot.car.forget()
        hold = drive_until(driver, drives(robot), 'the car drives on')
        driver.say(release={'hold': hold})
        until(stands(robot), 'the car stands')
        robot.car.forget()
        drive_until(driver, drives(robot), 'the car drives again')
        until(stands(robot), 'the car stands as its page falls silent')
    other.until(lambda page: page.known.get('wire', {}).get('frames'), 'frames come after it')
    other.close()


def test_publishers_follow_who_looks_though_the_master_hung_meanwhile(controls, robot, core):
    def publishes():
        return controls.node in publishers_and_subscribers()[0].get(NODE + '/speed', ())
    page = Page(controls, TOKEN)
    until(publishes, 'somebody looks')
    with core.hung():
        page.close()
        wait(2)
        page = Page(controls, TOKEN)
        page.until(lambda page: 'node' in page.known, 'the page is there')
    robot.car.forget()
    drive_until(page, drives(robot), 'the car drives')
    page.close()
    until(lambda: not publishes(), 'nobody looks')


def nothing(_panel):
    pass


def look(panel):
    """Have it register what the wire needs."""
    Page(panel, TOKEN, watch=['serial_msg'])
    wait(0.3)


def call(panel):
    """Have it look a service up."""
    page = Page(panel, TOKEN)
    page.until(lambda page: page.now, 'the page is there')
    lift(page, 'key')
    page.until(lambda page: 'key' in page.calls, 'the call is under way')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('what', [nothing, look, call])
def test_a_signal_ends_it_while_the_master_hangs(robot, core, number, what):
    panel = Panel('--control', '--token', TOKEN, name='panel_hung')
    page = Page(panel, TOKEN)
    page.until(lambda page: page.known.get('trouble') == '', 'it is registered, and looks')
    with core.hung():
        what(panel)
        assert panel.end(number) == 0
    assert 'Traceback' not in panel.output()


def test_a_signal_ends_it_as_it_starts_while_the_master_hangs(core):
    with core.hung():
        panel = Panel(name='panel_hung')
        assert panel.end() == 0


def test_a_terminal_that_takes_nothing_holds_up_no_page(robot):
    reads, writes = os.pipe()
    port = free_port()
    panel = subprocess.Popen([program('panel'), '--port', str(port), '__name:=panel_mute'],
                             stdout=writes, stderr=writes)
    try:
        until(lambda: b'http://' in os.read(reads, 1000), 'it listens')
        place = types.SimpleNamespace(port=port)
        page = Page(place)
        page.until(lambda page: page.known.get('trouble') == '', 'it is a node and logs as one')
        os.set_blocking(writes, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writes, bytes(1000))
        os.set_blocking(writes, True)       # this holds for the panel's end, too
        assert Page(place, origin='http://evil.example').status == 403     # a line of its log
        seen = page.now
        page.until(lambda page: page.now > seen + 0.5, 'the page is told what is new')
        panel.send_signal(signal.SIGINT)
        assert panel.wait(PATIENCE) == 0
    finally:
        panel.kill()
        os.close(reads)
        os.close(writes)


def test_what_a_master_that_hung_kept_back_moves_nothing(driver, robot, core):
    robot.bus.forget()
    with core.hung():
        lift(driver, 'late')
        driver.until(lambda page: 'late' in page.calls, 'the call is under way')
        wait(2.5)
        assert not driver.calls['late'].get('outcome')
    driver.until(lambda page: page.calls['late'].get('outcome'), 'the answer')
    assert driver.calls['late']['outcome'] == 'refused'
    assert 'nothing was sent' in driver.calls['late']['words']
    assert not robot.lifts


def test_what_a_bridge_that_hung_kept_back_moves_nothing(driver, robot):
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
    assert not robot.lifts


def test_what_a_panel_that_was_suspended_finds_moves_nothing(driver, controls, robot):
    robot.bus.forget()
    led = arduino.encode(arduino.LedCommand('old'))
    os.kill(controls.process.pid, signal.SIGSTOP)
    try:
        lift(driver, 'late')
        driver.say(led={'key': 'old', 'text': 'old'})
        wait(2.5)
    finally:
        os.kill(controls.process.pid, signal.SIGCONT)
    for key in ('late', 'old'):
        driver.until(lambda page, key=key: any(
            update.get('refused', {}).get('key') == key for update in list(page.updates)),
            f'{key} is refused')
    assert not robot.lifts and led not in robot.car.commands
