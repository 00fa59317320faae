"""The page in a real browser: what it shows against the topics, what it does to the robot, and
how it bears what happens to bridge, master, panel and line."""
import os
import re
import shutil
import signal
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
import rospy
from boards import Diagnostics, Topic as Heard, ranges, until
from panel_stage import NODE, TOKEN, Network, Panel, free_port

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3
from sensor_msgs.msg import Imu, Range
from std_msgs.msg import Float32, Float64, Int64, String
from std_srvs.srv import SetBool, SetBoolResponse

from serial_communication.link.outcome import NOT_SENT, Outcome
from serial_communication.msg import Environment, SteeringFeedback, Ticks, Voltage, McuStatus2
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.tools.watch.topics import TOPICS

if not shutil.which('chromedriver') and os.path.isdir('/opt/ros/noetic'):
    pytest.skip('no browser here: Ubuntu has chromium as a snap alone, which no driver starts',
                allow_module_level=True)

from panel_browser import Browser  # noqa: E402

LEFT, RIGHT = '\ue012', '\ue014'
UP = '\ue013'


@pytest.fixture(scope='module')
def chromium():
    browser = Browser()
    yield browser
    browser.quit()


@pytest.fixture
def page(chromium, panel):
    """The page of the panel that only looks, live; without an error in its console at the end."""
    chromium.open(panel.url)
    chromium.wait_for_text('#connection', 'live')
    yield chromium
    assert chromium.errors() == []


@pytest.fixture(scope='module')
def network(controls):
    """Between the browser and the panel that takes commands."""
    network = Network(controls)
    yield network
    network.close()


@pytest.fixture
def cockpit(chromium, controls, network, robot):
    """The page of the panel that takes commands."""
    chromium.open(network.url)
    chromium.wait_for_text('#connection', 'live')
    until(lambda: robot.car.connected, 'the car is there')
    chromium.wait_for_text('[data-link="bus"] .summary', 'ready')
    robot.car.forget()
    robot.bus.forget()
    yield chromium
    chromium.script("document.getElementById('pad').blur()")
    assert chromium.errors() == []


# -- what it shows ----------------------------------------------------------------------------


def test_each_number_is_its_topics(page, robot):
    """Every reading on the page against the message, by the digits that the topic's value has."""
    robot.imu = arduino.Imu(15000, 3000, -4000, 4000, 100, -200, 300, 1000, -500, 8000, 320)
    robot.bus.air = bus.Environment(417, 31.25, 55.5)
    types = {'~imu': Imu, '~voltage': Voltage, '~ticks': Ticks, '~environment': Environment,
             '~steering_angle': SteeringFeedback, 'mcu/status': McuStatus2}
    table = {topic.name: topic for topic in TOPICS}
    heard = {name: Heard(name.replace('~', NODE + '/'), each) for name, each in types.items()}
    page.wait_for_text('[data-reading="~environment:smoke"] .number', '417')
    readings = page.readings()
    assert len(readings) >= 18
    seen = set()
    for reading in readings:
        name, field = reading.split(':')
        if name not in heard:
            continue
        message = heard[name].next()
        value = next(each for each in table[name].values(message) if each.name == field)
        page.wait_for_text(f'[data-reading="{reading}"] .number',
                           f'{value.value:.{value.digits}f}'.replace('-', '\N{MINUS SIGN}'))
        seen.add(name)
    assert seen == set(types)
    for topic in heard.values():
        topic.close()


def test_ranges_as_bars_with_their_limits(page, robot):
    heard = Heard('/mcu/range_1', Range)
    message = heard.first()
    card = '[data-range="mcu/range_1"]'
    page.wait_for_text(card + ' .number', '0.470 m')
    assert page.text(card + ' .limits') == \
        f'{message.min_range:.2f} m\n{message.max_range:.2f} m'
    assert page.attribute(card + ' [role=meter]', 'aria-valuenow') == '0.470'
    width = page.script("return document.querySelector(arguments[0]).style.width", card + ' .fill')
    assert width == f'{(0.47 - message.min_range) / (message.max_range - message.min_range):.1%}'
    for millimetres, words, mark in ((65535, 'no reading', 'none'),
                                     (9000, 'farther than 2.00 m', 'far'),
                                     (5, 'nearer than 0.03 m', 'near')):
        robot.ranges = ranges(millimetres)
        page.wait_for_text(card + ' .number', words)
        assert page.attribute(card, 'data-beyond') == mark
    robot.ranges = ranges()
    heard.close()


TITLES = {'bus': 'control board', 'arduino': 'model car', 'mcu': 'sensor board'}


def test_links_are_as_diagnostics_say(page):
    diagnostics = Diagnostics()
    for name, status in diagnostics.wait_for_all(TITLES, lambda *_: True, 'a status').items():
        card = f'[data-link="{name}"]'
        assert page.text(card + ' .card-head .note') == TITLES[name]
        assert page.text(card + ' .port') == status.keys['port']
        page.script("document.querySelector(arguments[0]).open = true", card + ' details')

        def as_said(page, name=name, card=card):
            latest = diagnostics.statuses(name)[-1]
            shown = dict(page.script(
                "return [...document.querySelectorAll(arguments[0])].map(row => "
                "[...row.children].map(cell => cell.textContent))", card + ' details tr'))
            return page.text(card + ' .summary') == latest.message and shown == latest.keys
        page.wait(as_said, f'{name}: words and all keys of the latest status')


def test_a_heartbeat_gap_is_red_until_it_is_over_and_what_was_dropped_is_shown(page, robot):
    card = '[data-link="arduino"]'
    bad = card + ' dd[data-bad]'
    page.wait(lambda page: page.attribute(card, 'data-look') == 'ok', 'it is well')
    robot.bridge.process.send_signal(signal.SIGSTOP)
    threading.Event().wait(0.5)      # a stall: what waits meanwhile is dropped
    robot.bridge.process.send_signal(signal.SIGCONT)
    page.wait(lambda page: 'heartbeat gap of' in page.text(card + ' .summary')
              and len(page.all(bad)) == 1, 'the gap is said, and red')
    page.wait(lambda page: re.search(r'stale\s+[1-9][0-9]* bytes', page.text(card + ' .facts')),
              'the bytes that waited meanwhile are counted')
    page.wait(lambda page: page.attribute(card, 'data-look') == 'ok' and page.all(bad) == [],
              'it is over')


def test_an_error_is_seen_and_counted_by_its_cause(page, robot):
    card = '[data-link="mcu"]'
    page.wait(lambda page: page.attribute(card, 'data-look') == 'ok', 'it is well')
    before = int(page.text(card + ' .count'))
    for _ in range(3):
        robot.sensors.write(b'\x02\x0c\x10\x00' + bytes(10) + b'\x00\x03')    # a false CRC
    page.wait(lambda page: page.attribute(card, 'data-look') == 'warn', 'it is in trouble')
    page.wait(lambda page: int(page.text(card + ' .count')) >= before + 3, 'three are counted')
    assert 'checksum' in page.text(card + ' .causes')
    page.wait(lambda page: page.title.startswith('! mcu: trouble'), 'the tab says so')
    assert 'mcu link: trouble' in page.script(
        "return document.getElementById('announcer').textContent")


def test_what_is_no_longer_renewed_says_how_old_it_is(page, robot):
    robot.others = robot.others[1:]         # no VOLTAGE; all else goes on
    try:
        reading = '[data-reading="~voltage:voltage"]'
        page.wait(lambda page: page.attribute(reading, 'data-state') == 'stale', 'it is grey')
        assert page.text(reading + ' .age').endswith(' old')
        assert page.attribute('[data-reading="~ticks:ticks"]', 'data-state') == 'fresh'
    finally:
        robot.others = [arduino.Voltage(7.4)] + robot.others
    page.wait(lambda page: page.attribute(reading, 'data-state') == 'fresh', 'it is fresh again')
    assert page.text(reading + ' .age') == ''


def test_a_hostile_text_is_words(page, robot):
    text = '<img src=x onerror=document.title="pwned"><script>document.title="pwned"</script>'
    page.script("document.getElementById('card-wire').open = true")

    def shows(page):
        return text in page.text('.log') and page.script(
            "return [...document.querySelectorAll('.chip')]"
            ".some(chip => chip.textContent.includes('WARN'))")
    page.wait(shows, 'log and wire show it', doing=lambda: robot.car.say(arduino.Log(2, text)))
    assert page.all('.log img') == page.all('.log script') == page.all('.frame img') == []
    assert 'pwned' not in page.title
    page.script("document.getElementById('card-wire').open = false")


def test_the_wire(page, robot):
    page.click('#card-wire > summary')
    page.wait(lambda page: len(page.all('.frame')) == 16, 'frames are shown')
    for word in ('mcu', 'arduino'):
        page.wait(lambda page: word in page.texts('.chip'), word)
    page.script("[...document.querySelectorAll('.chip')]"
                ".find(chip => chip.textContent == 'arduino').click()")
    page.wait(lambda page: {link.split()[0] for link in page.texts('.frame-link')} <= {
        'mcu', 'bus'}, 'the arduino is filtered out')
    page.click('.tools button')       # pause
    shown = page.text('.frames')
    page.wait(lambda page: page.text('.wire .note[role=status]') == 'paused', 'it says so')
    page.wait_for_updates(20)
    assert page.text('.frames') == shown
    page.click('.tools button')
    page.wait(lambda page: page.text('.frames') != shown, 'it goes on')
    page.click('#card-wire > summary')


def test_a_field_and_its_bytes(page, robot):
    """Point at a field and see its bytes, and at bytes and see their field."""
    page.click('#card-wire > summary')
    page.wait(lambda page: page.all('.frame'), 'frames come')
    page.script("[...document.querySelectorAll('.chip')]"
                ".filter(chip => !/sensor status|mcu$/.test(chip.firstChild.textContent)"
                " && chip.ariaPressed == 'true').forEach(chip => chip.click())")
    page.wait(lambda page: set(page.texts('.frame-link')) == {'mcu \u2190'},
              'only the sensor board is shown')
    page.script("document.querySelector('.frame').click()")
    fields = dict(page.script("return [...document.querySelectorAll('.fields > div')].map(field =>"
                              "[field.querySelector('dt').textContent,"
                              " [...field.querySelectorAll('dd')].map(each => each.textContent)])"))
    assert fields['range_1'] == ['470 mm', 'bytes 4 \u2013 5']
    assert fields['CRC'][1] == 'byte 14'
    for points_at, lights_up, words in (
            ('.fields > div:nth-child(5)', '.frame-detail .byte[data-lit]', 'd6 01'),    # 470
            ('.frame-detail .byte:nth-child(5)', '.fields [data-lit] dt', 'range_1')):
        page.wait(lambda page: page.texts(lights_up) == [words], f'{words} lights up',
                  doing=lambda: page.hover(points_at))
    page.click('#card-wire > summary')


def test_own_topics_appear_by_themselves(chromium, core):
    """This process plays a bridge that publishes what no other does."""
    wind = rospy.Publisher('~wind', Vector3, queue_size=1)
    words = rospy.Publisher('~motto', String, queue_size=1)
    panel = Panel('--node', rospy.get_name(), name='panel_own')
    try:
        chromium.open(panel.url)
        chromium.wait_for_text('#connection', 'live')
        done = threading.Event()

        def publish():
            while not done.wait(0.05):
                wind.publish(1.5, -2.25, 1.25e-9)
                words.publish('<b>semper idem</b>')
        threading.Thread(target=publish, daemon=True).start()
        card = '[data-own="~wind"] '
        chromium.wait_for_text('[data-reading="~wind:y"] .number', '\N{MINUS SIGN}2.25')
        assert chromium.text('[data-reading="~wind:x"] .number') == '1.5'
        assert chromium.text('[data-reading="~wind:z"] .number') == '1.25e\N{MINUS SIGN}9'
        assert chromium.all(card + 'canvas')
        chromium.wait_for_text('[data-reading="~motto:data"] .number', '<b>semper idem</b>')
        assert not chromium.all('[data-own="~motto"] canvas')
        # A range with limits that are none, from another's program: the page bears it.
        odd = rospy.Publisher('~odd', Range, queue_size=1, latch=True)
        odd.publish(min_range=float('nan'), max_range=float('inf'), range=0.25)
        third = rospy.Publisher('~later', Float32, queue_size=1, latch=True)
        third.publish(7.0)
        chromium.wait_for_text('[data-reading="~odd:range"] .number', '0.250')
        odd.unregister()
        chromium.wait_for_text('[data-reading="~later:data"] .number', '7')
        third.unregister()
        chromium.wait(lambda page: not page.all('[data-own="~later"]'), 'it goes with its topic')
        done.set()
        assert chromium.errors() == []
    finally:
        wind.unregister()
        words.unregister()
        chromium.open('about:blank')
        panel.end()


def test_odd_numbers_and_names_are_borne(chromium, core):
    """What a program that calls itself a bridge may publish."""
    values = {'big': (Int64, 2 ** 43), 'bigger': (Int64, 2 ** 63 - 1),
              'huge': (Float64, 1.7e308), 'least': (Float64, -1.7e308), 'level': (Float64, 1e300)}
    publishers = {name: (rospy.Publisher('~' + name, kind, queue_size=1), number)
                  for name, (kind, number) in values.items()}
    diagnostics = rospy.Publisher('/diagnostics', DiagnosticArray, queue_size=1)
    causes = {'constructor': '3', '__proto__': '4', 'x' * 5000: '5', 'square': '\u00b2'}
    status = DiagnosticStatus(name='odd: constructor link', message='m' * 5000, values=[
        KeyValue(f'{cause} errors', count) for cause, count in causes.items()]
        + [KeyValue('port', 'p' * 5000), KeyValue('timeouts', 't' * 5000)])
    panel = Panel('--node', rospy.get_name(), name='panel_odd')
    done = threading.Event()

    def publish():
        while not done.wait(0.05):
            for publisher, number in publishers.values():
                publisher.publish(number)
            for pair in status.values[:2]:
                pair.value = str(int(pair.value) + 1)
            diagnostics.publish(DiagnosticArray(status=[status]))
    threading.Thread(target=publish, daemon=True).start()
    try:
        chromium.open(panel.url)
        chromium.wait_for_text('#connection', 'live')
        for name, text in (('big', str(2 ** 43)), ('bigger', str(2 ** 63 - 1)),
                           ('huge', '1.7e+308'), ('least', '\N{MINUS SIGN}1.7e+308')):
            chromium.wait_for_text(f'[data-reading="~{name}:data"] .number', text)
        chromium.wait_for_updates(20)       # and all are drawn
        card = '[data-link="constructor"] '
        for cause in ('constructor', '__proto__'):
            chromium.wait(lambda page, cause=cause: int(page.text(
                f'{card} [data-cause="{cause}"] b') or 0) > 0, f'{cause} is counted')
        assert 'function' not in chromium.text(card)
        assert chromium.script('return document.documentElement.scrollWidth <= innerWidth')
        chromium.resize(390, 844)
        chromium.wait(lambda page: page.script(
            'return innerWidth == 390 && document.documentElement.scrollWidth == 390'), 'it fits')
        assert chromium.errors() == []
    finally:
        done.set()
        chromium.resize(1600, 1000)
        chromium.open('about:blank')
        for publisher, _number in publishers.values():
            publisher.unregister()
        diagnostics.unregister()
        panel.end()


def test_an_error_of_a_while_ago_is_still_counted_and_no_trouble_any_more(page):
    """That of test_an_error_is_seen_and_counted_by_its_cause; 10 s have passed then."""
    card = '[data-link="mcu"]'
    page.wait(lambda page: page.attribute(card, 'data-look') == 'ok', 'it is well again')
    assert 'checksum' in page.text(card + ' .causes')


def test_a_phone(page):
    page.resize(390, 844)
    try:
        page.wait(lambda page: page.script('return innerWidth') == 390, 'it is narrow')
        assert page.script('return document.documentElement.scrollWidth') == 390
        for card in page.all('.card'):
            if card.is_displayed():
                assert card.rect['x'] >= 0 and card.rect['x'] + card.rect['width'] <= 390
    finally:
        page.resize(1600, 1000)


def test_dark_and_light_follow_the_system(page):
    grounds = []
    for scheme in ('light', 'dark'):
        page.scheme(scheme)
        grounds.append(page.script('return getComputedStyle(document.body).backgroundColor'))
    page.scheme('light')
    assert grounds == ['rgb(243, 244, 246)', 'rgb(14, 17, 20)']


def test_keyboard_and_screen_reader_reach_everything(cockpit):
    """Whatever can be pressed is reached by Tab, and has a name."""
    wanted = cockpit.script(
        "return [...document.querySelectorAll('button, input, summary, [tabindex]')]"
        ".filter(e => e.checkVisibility() && !e.disabled).length")
    cockpit.script("document.activeElement.blur(); window.reached = new Set();"
                   "document.addEventListener('focusin', e => reached.add(e.target))")
    for _ in range(wanted + 5):
        cockpit.press('\ue004')
    assert cockpit.script('return reached.size') >= wanted
    nameless = [node for node in cockpit.accessibility() if node['role']['value'] in (
        'button', 'textbox', 'spinbutton', 'slider', 'meter', 'image', 'region', 'application')
        and not node.get('name', {}).get('value')]
    assert nameless == []


# -- what it does -----------------------------------------------------------------------------


def test_lift_moves_once_at_a_double_click(cockpit, robot):
    up = '[data-service="~lift"] button'
    cockpit.double_click(up)
    cockpit.wait(lambda page: 'done' in page.text('.answers'), 'the answer is there')
    cockpit.wait(lambda page: page.all(up)[0].is_enabled(), 'the button is enabled again')
    assert [request.data for request in robot.lifts] == [bytes((0, 20))]
    assert 'lift up 20 mm done' in cockpit.text('.answers li')


def test_a_control_is_disabled_until_its_answer_is_there(cockpit, robot):
    robot.bus.script.append(b'')        # no answer, until it is given up
    down = '[data-service="~lift"] button:last-of-type'
    cockpit.click(down)
    # Both are looked at in the same moment: the call is under way for a second.
    cockpit.wait(lambda page: page.script(
        "return document.querySelector('.answers').innerText.includes('under way') &&"
        "[...document.querySelectorAll('[data-service=\"~lift\"] button')]"
        ".every(button => button.disabled)"), 'it is under way, and every button is disabled')
    cockpit.wait(lambda page: page.attribute('.answers li', 'data-outcome') == 'not known',
                 'the outcome is told as not known')
    cockpit.wait(lambda page: page.all(down)[0].is_enabled(), 'the button is enabled again')
    assert 'not known' in cockpit.text('.answers li .outcome')
    assert 'look before you repeat it' in cockpit.text('.answers li')
    assert len(robot.lifts) == 1


def drop_connection(page, network):
    """Cut the page off, and connect it again as it has noticed."""
    network.cut()
    page.wait_for_text('#connection', 'no connection')
    network.mend()
    page.wait_for_text('#connection', 'live')
    page.errors()      # that the network was gone is in the console, and has to be


def test_an_answer_that_the_connection_did_not_live_to_see_is_not_known(cockpit, robot, network):
    robot.bus.script.append(b'')
    cockpit.click('[data-service="~lift"] button')
    until(lambda: robot.lifts, 'the board has got it')
    drop_connection(cockpit, network)
    cockpit.wait(lambda page: any('the connection went before the answer came' in each
                                  for each in page.texts('.answers li')), 'it says so')
    until(lambda: cockpit.all('[data-service="~lift"] button')[0].is_enabled(), 'it is over')


def test_calibration_is_confirmed_first(cockpit, robot):
    packet = arduino.encode(arduino.ImuCalibration())
    cockpit.click('[data-service="~calibrate_imu"] button')
    cockpit.wait(lambda page: page.script("return document.querySelector('dialog').open"),
                 'it asks')
    cockpit.click('dialog button:last-of-type')
    assert packet not in robot.car.commands
    cockpit.click('[data-service="~calibrate_imu"] button')
    robot.talks = False          # as a board does while it calibrates
    try:
        cockpit.click('dialog button')
        until(lambda: packet in robot.car.commands, 'the board is told')
        cockpit.wait(lambda page: 'being calibrated for' in page.text(
            '[data-service="~calibrate_imu"] .words'), 'the time that has passed')
    finally:
        robot.talks = True
    cockpit.wait(lambda page: page.text('[data-service="~calibrate_imu"] .words') == '', 'over')


def test_led_echo_and_sync(cockpit, robot):
    led = arduino.encode(arduino.LedCommand('brake'))
    cockpit.click('[data-service="~led"] button:nth-of-type(3)')
    until(lambda: led in robot.car.commands, 'the LED is told')
    for word in ('echo', 'sync'):
        cockpit.script("[...document.querySelectorAll('.commands button')]"
                       ".find(b => b.textContent == arguments[0]).click()", word)
        cockpit.wait(lambda page: any(each.startswith(word + ' done') for each in page.texts(
            '.answers li')), word)


def came_late(page):
    """Whether the latest press was refused for its age, as may be on a busy machine."""
    return 'press again' in (page.text('.answers li') if page.all('.answers li') else '')


def test_own_functions(chromium, core):
    """This process plays a bridge with a function of the configuration."""
    asked = []

    def press_again():
        button = chromium.all(form + 'button')[0]
        if came_late(chromium) and button.is_enabled():
            button.click()

    def pump(request):
        asked.append(request.data)
        return SetBoolResponse(request.data, 'the pump runs' if request.data
                               else Outcome(NOT_SENT, 'it is empty').text)
    rospy.set_param('~bus/functions/pump', {'cmd2': 48, 'srv_type': 'std_srvs/SetBool'})
    there = rospy.Publisher('~there', String, queue_size=1)
    service = rospy.Service('~pump', SetBool, pump)
    panel = Panel('--control', '--node', rospy.get_name(), name='panel_functions')
    try:
        chromium.open(panel.url)
        form = '[data-service="~pump"] '
        chromium.wait(lambda page: page.all(form + 'button'), 'the function is offered')
        for outcome in ('refused', 'done'):
            chromium.wait(lambda page: page.all(form + 'button')[0].is_enabled(), 'it is free')
            chromium.click(form + 'button')
            chromium.wait(lambda page: page.attribute('.answers li', 'data-outcome') == outcome
                          and not came_late(page), outcome, doing=press_again)
            chromium.click(form + 'input')
        assert asked == [False, True]
        answers = chromium.text('.answers')
        assert 'the pump runs' in answers and 'it is empty' in answers
        assert chromium.errors() == []
    finally:
        chromium.open('about:blank')
        service.shutdown()
        there.unregister()
        rospy.delete_param('~bus')
        panel.end()


# -- the dead man's switch --------------------------------------------------------------------


def hold(page, robot):
    """Press the pad ahead of its middle, and hold.

    Where the machine stands still for too long meanwhile, the pad has to let go; then again.
    """
    def press():
        if page.attribute('#pad', 'data-held') is None:
            page.release()
            page.press_at('#pad', 0, -60)

    def drives():
        # The page shows that it holds a frame later than it does: what is to end must be shown.
        return any(speed > 0 for speed in robot.car.speeds) \
            and page.attribute('#pad', 'data-held') is not None
    until(drives, 'the car drives', doing=press, every=0.3)


def stands(robot, page):
    until(lambda: robot.car.speeds[-1] == 0, 'the car stands')
    page.wait(lambda page: page.attribute('#pad', 'data-held') is None, 'the pad is let go')
    count = len(robot.car.speeds)
    page.wait_for_updates(15)
    assert not any(robot.car.speeds[count:])


def test_it_stops_on_release(cockpit, robot):
    hold(cockpit, robot)
    cockpit.release()
    stands(robot, cockpit)


def test_it_stops_on_blur(cockpit, robot):
    hold(cockpit, robot)
    cockpit.script("document.getElementById('speed-limit').focus()")
    stands(robot, cockpit)
    cockpit.release()


def test_it_stops_as_the_window_loses_the_focus(cockpit, robot):
    hold(cockpit, robot)
    cockpit.script("window.dispatchEvent(new Event('blur'))")
    stands(robot, cockpit)
    cockpit.release()


def test_it_stops_on_a_hidden_tab(cockpit, robot):
    hold(cockpit, robot)
    with cockpit.other_tab():
        until(lambda: robot.car.speeds[-1] == 0, 'the car stands')
    stands(robot, cockpit)
    cockpit.release()


def test_it_stops_on_a_lost_connection(cockpit, robot, network):
    hold(cockpit, robot)
    drop_connection(cockpit, network)
    stands(robot, cockpit)
    cockpit.release()


def test_what_the_network_kept_back_does_not_drive(cockpit, robot, network):
    hold(cockpit, robot)
    network.keep_back()
    try:
        until(lambda: robot.car.speeds[-1] == 0, 'the car stands')
        cockpit.wait(lambda page: page.attribute('#pad', 'data-held') is None, 'it lets go')
        cockpit.release()
        # Pressed again while nothing arrives: the pad does not even try, or what it says is old.
        cockpit.press_at('#pad', 0, -60)
        cockpit.release()
        robot.car.forget()
    finally:
        network.deliver()
    cockpit.wait_for_text('#connection', 'live')
    cockpit.wait_for_updates(15)
    assert not any(robot.car.speeds)


def test_it_stops_as_the_panel_falls_silent(cockpit, robot, controls):
    hold(cockpit, robot)
    os.kill(controls.process.pid, signal.SIGSTOP)
    try:
        cockpit.wait(lambda page: page.attribute('#pad', 'data-held') is None, 'it lets go')
        assert cockpit.text('#pad-words').startswith('stopped: ')
        until(lambda: robot.car.speeds[-1] == 0, 'the bridge stops the car')
    finally:
        os.kill(controls.process.pid, signal.SIGCONT)
    cockpit.wait_for_text('#connection', 'live')
    stands(robot, cockpit)
    cockpit.release()
    cockpit.errors()    # it may have tried another connection meanwhile


def test_it_stops_as_the_page_stands_still(cockpit, robot):
    """Nothing of the page runs any more: its silence stops the car."""
    hold(cockpit, robot)
    cockpit.script("const end = performance.now() + 1500; while (performance.now() < end);")
    assert 0 in robot.car.speeds
    cockpit.release()
    stands(robot, cockpit)


def test_keys_drive(cockpit, robot):
    cockpit.script("document.getElementById('pad').focus()")

    def hold_keys(*keys):
        if cockpit.attribute('#pad', 'data-held') is None:      # as in `hold`
            cockpit.key_up(UP)
            cockpit.key_up(RIGHT)
            for key in keys:
                cockpit.key_down(key)
    until(lambda: 200 in robot.car.speeds, 'the car drives', doing=lambda: hold_keys(UP),
          every=0.3)
    cockpit.key_down(RIGHT)
    until(lambda: arduino.encode(arduino.SteeringCommand(1900)) in robot.car.commands, 'it turns',
          doing=lambda: hold_keys(UP, RIGHT), every=0.3)
    cockpit.key_up(RIGHT)
    cockpit.key_up(UP)
    stands(robot, cockpit)


SHIFT, META = 8, 4       # as Input.dispatchKeyEvent has them


def press_ahead(page, **more):
    """Press the key that drives ahead, and hold it."""
    page.key_event('keyDown', 'ArrowUp', 'ArrowUp', **more)


def hold_ahead(page, robot):
    """Have the car drive by the key that drives ahead; as in `hold`."""
    def press():
        if page.attribute('#pad', 'data-held') is None:
            page.key_event('keyUp', 'ArrowUp', 'ArrowUp')
            press_ahead(page)
    page.script("document.getElementById('pad').focus()")
    until(lambda: 200 in robot.car.speeds and page.attribute('#pad', 'data-held') is not None,
          'the car drives', doing=press, every=0.3)


def test_a_keypad_whose_key_is_released_as_another_does_not_drive(cockpit, robot):
    """NumLock and Shift: the key goes down as an arrow and, Shift being released first, up as 8."""
    cockpit.script("document.getElementById('pad').focus()")
    keypad = {'location': 3, 'isKeypad': True}
    cockpit.key_event('keyDown', 'Shift', 'ShiftLeft', modifiers=SHIFT, location=1)
    cockpit.key_event('keyDown', 'ArrowUp', 'Numpad8', modifiers=SHIFT, **keypad)
    cockpit.key_event('keyUp', 'Shift', 'ShiftLeft', location=1)
    cockpit.key_event('keyUp', '8', 'Numpad8', **keypad)
    cockpit.wait_for_updates(15)
    assert not any(robot.car.speeds)


@pytest.mark.parametrize('modifier', [META, SHIFT])
def test_no_key_drives_with_a_modifier(cockpit, robot, modifier):
    """macOS does not report that a key is released while Cmd is held."""
    cockpit.script("document.getElementById('pad').focus()")
    press_ahead(cockpit, modifiers=modifier)
    cockpit.wait_for_updates(15)
    assert not any(robot.car.speeds) and cockpit.attribute('#pad', 'data-held') is None


def test_any_other_key_stops_as_it_goes_down_or_up(cockpit, robot):
    for what, key, code, more in (
            ('keyDown', 'Meta', 'MetaLeft', {'modifiers': META}), ('keyDown', 'x', 'KeyX', {}),
            ('keyUp', '8', 'Numpad8', {}), ('keyUp', 'ArrowUp', 'Numpad8', {})):
        robot.car.forget()
        hold_ahead(cockpit, robot)
        cockpit.key_event(what, key, code, **more)
        stands(robot, cockpit)
        press_ahead(cockpit, autoRepeat=True)       # it is still held, and repeats
        stands(robot, cockpit)
        cockpit.key_event('keyUp', 'ArrowUp', 'ArrowUp')


def test_pad_and_keys_do_not_drive_together(cockpit, robot):
    hold(cockpit, robot)
    press_ahead(cockpit)
    stands(robot, cockpit)
    cockpit.key_up(UP)
    cockpit.release()
    hold_ahead(cockpit, robot)
    cockpit.press_at('#pad', 0, 60)
    stands(robot, cockpit)
    assert min(robot.car.speeds) == 0
    cockpit.release()
    cockpit.key_up(UP)


def test_a_key_that_has_ceased_to_repeat_counts_as_released(cockpit, robot):
    hold_ahead(cockpit, robot)
    press_ahead(cockpit, autoRepeat=True)
    stands(robot, cockpit)
    cockpit.key_event('keyUp', 'ArrowUp', 'ArrowUp')
    # And since this system repeats keys, one that never begins to has been released, too.
    hold_ahead(cockpit, robot)
    stands(robot, cockpit)
    cockpit.key_event('keyUp', 'ArrowUp', 'ArrowUp')


def drives_on(page, robot, hold_keys, seconds=4.0):
    """Whether the car drives ahead for so long without another event of the keyboard.

    Where the machine stands still for too long meanwhile, the hold ends; then again.
    """
    def held():
        return page.attribute('#pad', 'data-held') is not None
    for _ in range(10):
        hold_keys()
        began = time.monotonic()
        until(lambda: not held() or time.monotonic() - began > seconds, 'the time has passed')
        if held():
            count = len(robot.car.speeds)
            until(lambda: len(robot.car.speeds) > count, 'another speed comes')
            return robot.car.speeds[-1] == 200
        assert 'repeats' not in page.text('#pad-words')
    return False


def test_holding_is_enough_where_the_system_repeats_no_keys(cockpit, robot):
    assert drives_on(cockpit, robot, lambda: hold_ahead(cockpit, robot))
    cockpit.key_up(UP)
    stands(robot, cockpit)


def test_a_key_that_is_held_beside_another_need_not_repeat(cockpit, robot):
    """Systems repeat the key that was pressed last, and none any more after its release."""
    def ahead_and_once_right():
        hold_ahead(cockpit, robot)
        press_ahead(cockpit, autoRepeat=True)
        cockpit.key_down(RIGHT)
        cockpit.key_event('keyDown', 'ArrowRight', 'ArrowRight', autoRepeat=True)
        cockpit.key_up(RIGHT)
    assert drives_on(cockpit, robot, ahead_and_once_right)
    cockpit.key_up(UP)
    stands(robot, cockpit)


# -- what happens around it -------------------------------------------------------------------


def test_unplug_and_replug(page, robot):
    robot.lines['mcu'].unplug()
    card = '[data-link="mcu"]'
    page.wait(lambda page: page.attribute(card, 'data-look') == 'error', 'it is down')
    assert page.text(card + ' .summary').startswith('closed: ')
    page.wait(lambda page: page.attribute('[data-range="mcu/range_1"]', 'data-state') == 'stale',
              'the range is old')
    robot.lines['mcu'].plug()
    page.wait(lambda page: page.attribute(card, 'data-look') == 'ok', 'it is well again')
    page.wait(lambda page: page.attribute('[data-range="mcu/range_1"]', 'data-state') == 'fresh',
              'the range is fresh')


def test_restart_of_the_bridge(page, robot):
    robot.bridge.end()
    page.wait(lambda page: 'no bridge ' + NODE in page.text('#trouble'), 'the page says so')
    assert page.attribute('[data-link="bus"]', 'data-look') in ('none', 'ok')
    page.wait(lambda page: page.attribute('[data-link="bus"]', 'data-look') == 'none', 'grey')
    robot.start_bridge()
    page.wait(lambda page: page.text('#trouble') == '', 'it is back')
    page.wait(lambda page: page.attribute('[data-link="bus"]', 'data-look') == 'ok', 'well')
    page.wait(lambda page: page.attribute('[data-reading="~imu:roll"]', 'data-state') == 'fresh',
              'data comes again')


def test_restart_of_the_master(page, robot, core):
    core.stop()
    page.wait(lambda page: 'no answer from the ROS master' in page.text('#trouble'),
              'the page says so')
    core.start()
    page.wait(lambda page: page.text('#trouble') == '', 'it is back')
    # What is new to the master is found as well: a topic that was not subscribed to before.
    page.click('#card-wire > summary')
    page.wait(lambda page: page.all('.frame'), 'serial_msg comes')
    page.click('#card-wire > summary')


def test_restart_of_the_panel(chromium, robot):
    port = free_port()
    first = Panel(port=port, name='panel_short')
    chromium.open(first.url)
    ticks = '[data-reading="~ticks:ticks"]'
    chromium.wait(lambda page: page.attribute(ticks, 'data-state') == 'fresh', 'numbers come')
    first.end()
    chromium.wait(lambda page: 'no connection to the panel' in page.text('#trouble'),
                  'the page says so')
    chromium.wait(lambda page: page.attribute(ticks, 'data-state') == 'stale', 'they are old')
    second = Panel(port=port, name='panel_short')
    chromium.wait_for_text('#connection', 'live')
    chromium.wait(lambda page: page.attribute(ticks, 'data-state') == 'fresh', 'they are fresh')
    chromium.errors()          # that a connection was refused is in the console, and has to be
    assert second.end() == 0


def test_a_page_of_another_site(chromium, panel):
    """It can open no connection, and show no frame of ours."""
    evil = f'''<title>evil</title><script>
      const socket = new WebSocket('ws://127.0.0.1:{panel.port}/socket');
      socket.onopen = () => document.title = 'open';
      socket.onerror = () => document.title = 'refused';
    </script><iframe src="http://127.0.0.1:{panel.port}/"></iframe>'''.encode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header('Content-Type', 'text/html')
            self.end_headers()
            self.wfile.write(evil)

        def log_message(self, *_arguments):
            pass

    # Threads: chromium opens a second connection in advance, on which nothing comes for a minute.
    server = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    chromium.open(f'http://localhost:{server.server_port}/')
    chromium.wait(lambda page: page.title == 'refused', 'the connection is refused')
    chromium.in_frame('iframe', lambda page: not page.all('#node'))
    # By a name of its own that resolves to us.
    chromium.open(f'http://rebinding.example:{panel.port}/')
    assert 'is no name of this machine' in chromium.text('body')
    server.shutdown()
    chromium.errors()


def test_a_wrong_token(chromium, controls):
    chromium.forget_cookies(controls.url)
    chromium.open(controls.url.split('?')[0])
    assert 'with its token' in chromium.text('body')
    chromium.open(controls.url)
    chromium.wait_for_text('#connection', 'live')
    assert TOKEN not in chromium.script('return location.href')
    chromium.errors()
