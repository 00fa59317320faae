"""The page in a browser: its display, its commands, and outages of bridge, master and panel."""
import contextlib
import shutil
import struct
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
import rospy
from boards import PACKAGE, Topic, again_if_stalled, settle, until
from panel_helpers import KEPT_BACK, NODE, TOKEN, Network

from geometry_msgs.msg import Twist, Vector3
from sensor_msgs.msg import Imu
from std_srvs.srv import SetBool

from serial_communication.msg import Environment, McuStatus2, SteeringFeedback, Ticks, Voltage
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.rows import SettingMessage
from serial_communication.tools.watch.topics import TOPICS

if not shutil.which('chromedriver'):
    pytest.skip('no browser: Ubuntu has chromium only as a snap, which no driver can start',
                allow_module_level=True)

from panel_browser import Browser, read_script  # noqa: E402

RIGHT = '\ue014'
UP = '\ue013'


@pytest.fixture(scope='module')
def chromium():
    browser = Browser()
    yield browser
    browser.quit()


@pytest.fixture
def page(chromium, panel):
    """The page of a read-only panel; at the end, its console must have no error."""
    chromium.open(panel.url)
    chromium.wait_for_text('#connection', 'live')
    yield chromium
    assert chromium.errors() == []


@pytest.fixture(scope='module')
def network(control_panel):
    """The network between the browser and the panel that takes commands."""
    network = Network(control_panel)
    yield network
    network.end()


@pytest.fixture
def control_page(chromium, control_panel, network, robot):
    """The page of the panel that takes commands."""
    chromium.open('about:blank')     # or only the part after # changes, and nothing is loaded
    chromium.open(network.url)
    chromium.wait_for_text('#connection', 'live')
    until(lambda: robot.car.connected, 'the car is connected')
    chromium.wait_for_text('[data-link="bus"] .summary', 'ready')
    wait_until_settled(chromium)
    robot.car.forget()
    settle(PACKAGE, robot.bus)
    yield chromium
    chromium.script("document.getElementById('pad')?.blur()")     # no pad: the test failed
    assert chromium.errors() == []


def wait_for_answer(page, words, **options):
    """Wait until an answer begins with these words."""
    page.wait(lambda page: any(each.startswith(words) for each in page.texts('.answers li')),
              f'the answer {words}', **options)


def wait_for_attribute(page, selector, name, value, **options):
    page.wait(lambda page: page.attribute(selector, name) == value, f'{selector} has {value}',
              **options)


def press(page, button, holds, what, click=None):
    """Press an enabled button until `holds(page)`; again if a stall kept the command back.

    Args:
        click: how to press it, called with `button`; by default one click.
    """
    before = page.texts('.answers li')

    def is_kept_back(answers):
        return KEPT_BACK.search(''.join(answers[:1]))

    def press_again():
        # First whether it is enabled: it is not from the click until the page shows an answer.
        if page.all(button + ':enabled'):
            answers = page.texts('.answers li')
            if answers == before or is_kept_back(answers):   # or it was disabled at the click
                (click or page.click)(button)
    page.wait(lambda page: page.all(button + ':enabled'), f'{button} is enabled')
    (click or page.click)(button)
    page.wait(lambda page: holds(page) and not is_kept_back(page.texts('.answers li')), what,
              doing=press_again)


def release_stop(page):
    """Wait until the page shows that STOP holds, and release it there."""
    wait_for_attribute(page, '#stop', 'aria-pressed', 'true')
    press(page, '#release', lambda page: page.attribute('#stop', 'aria-pressed') == 'false',
          'it is released')


def open_dialog(page, form):
    """Press the button of a function until it asks for a confirmation."""
    dialog = form + 'dialog[open]'
    page.wait(lambda page: page.all(dialog), 'the dialog is open',
              doing=lambda: page.all(dialog) or page.click(form + 'button'))


def confirm(page, form):
    """Press the button of a function that asks for a confirmation, and then the one to start."""
    open_dialog(page, form)
    page.click(form + 'dialog button')


def watch_texts(page, place):
    """Return a function that returns the texts that this element has shown since now."""
    page.script("""
        const place = document.querySelector(arguments[0]), texts = [place.textContent];
        (window.texts ??= {})[arguments[0]] = texts;
        new MutationObserver(() => texts.push(place.textContent)).observe(
            place, {childList: true});""", place)
    return lambda: page.script('return window.texts[arguments[0]]', place)


def wait_until_settled(page):
    """Wait until the page takes commands: it has neither appeared nor got the focus just now."""
    page.focus()        # or the first click of the test would do that
    # Until the page is drawn again, the controls look as before.
    page.script("document.getElementById('connection').textContent = 'not drawn yet'")
    page.wait_for_text('#connection', 'live')
    page.wait(lambda page: page.all('[data-service="~lift"] button:enabled'), 'it takes commands')


# -- the display ------------------------------------------------------------------------------


def test_every_reading_shows_the_value_of_its_topic(page, robot):
    robot.imu = arduino.Imu(15000, 3000, -4000, 4000, 100, -200, 300, 1000, -500, 8000, 320)
    robot.bus.air = bus.Environment(417, 31.25, 55.5)
    types = {'~imu': Imu, '~voltage': Voltage, '~ticks': Ticks, '~environment': Environment,
             '~steering_angle': SteeringFeedback, 'mcu/status': McuStatus2}
    table = {topic.name: topic for topic in TOPICS}
    received = {name: Topic(name.replace('~', NODE + '/'), each) for name, each in types.items()}
    page.wait_for_text('[data-reading="~environment:smoke"] .number', '417')
    page.wait(lambda page: set(types) <= {each.split(':')[0] for each in page.readings()},
              'every topic has been received')
    readings = page.readings()
    assert len(readings) >= 18
    seen = set()
    for reading in readings:
        name, field = reading.split(':')
        if name not in received:
            continue
        message = received[name].next(lambda m: getattr(m, 'connected', True))
        value = next(each for each in table[name].values(message) if each.name == field)
        page.wait_for_text(f'[data-reading="{reading}"] .number',
                           f'{value.value:.{value.digits}f}'.replace('-', '\N{MINUS SIGN}'))
        seen.add(name)
    assert seen == set(types)
    for topic in received.values():
        topic.close()


HOSTILE = '<img src=x onerror=document.title="pwned"><script>document.title="pwned"</script>'


def test_markup_in_a_text_is_shown_as_text(page, robot):
    text = HOSTILE
    page.script("document.getElementById('card-wire').open = true")

    def shows(page):
        return text in page.text('.log') and page.script(
            "return [...document.querySelectorAll('.chip')]"
            ".some(chip => chip.textContent.includes('WARN'))")
    page.wait(shows, 'log and wire show it', doing=lambda: robot.car.say(arduino.LOGS[2](text)))
    assert 'arduino' in page.texts('.log .link-name')       # it leads to the link's card
    assert page.all('.log img') == page.all('.log script') == page.all('.frame img') == []
    assert 'pwned' not in page.title
    page.script("document.getElementById('card-wire').open = false")


PHONE = (390, 844)


@contextlib.contextmanager
def phone(page):
    """Inside this block, the page is as large as a phone's."""
    page.resize(*PHONE)
    page.wait(lambda page: page.script('return innerWidth') == PHONE[0], 'it is narrow')
    try:
        yield
    finally:
        page.resize(1600, 1000)


def test_on_a_phone_each_part_is_a_tab_and_stop_always_in_sight(control_page, robot):
    page = control_page
    with phone(page):
        tabs = [tab for tab in page.texts('.tabs button') if tab]
        assert tabs == ['Links', 'Drive', 'Commands', 'Car', 'Sensors', 'Wire']
        for tab in tabs:
            shown, width, boxes, pad = page.script("""
                const every = (selector) => [...document.querySelectorAll(selector)];
                every('.tabs button').find((each) => each.textContent === arguments[0]).click();
                scrollTo(0, document.body.scrollHeight);
                const box = (element) => element.getBoundingClientRect();
                return [every('main [data-tab]').filter((each) => each.checkVisibility())
                            .map((each) => each.dataset.tab),
                        document.documentElement.scrollWidth,
                        every('#stop, .tabs button').map(box).map(({top, bottom}) => [top, bottom]),
                        box(document.getElementById('pad')).bottom];""", tab)
            assert set(shown) == {tab} and width == PHONE[0]
            assert all(top >= 0 and bottom <= PHONE[1] for top, bottom in boxes)
            assert tab != 'Drive' or 0 < pad < PHONE[1] - 60
        page.script("document.querySelector('.tabs button').click()")
        # A long name of a port is shortened in its middle.
        port = '[data-link="mcu"] .port'
        page.wait(lambda page: page.script(
            'return document.querySelector(arguments[0]).textContent', port)
            == robot.lines['mcu'].near, 'it is shown')
        begin, end = page.script("""
            const [begin, end] = document.querySelector(arguments[0]).children;
            begin.textContent = '/dev/serial/by-id/usb-Silicon_Labs_CP2102_USB_to_UART_Bridge_';
            return [begin, end].map(e => [e.scrollWidth, e.clientWidth,
                                          e.getBoundingClientRect().right]);""", port)
    assert begin[0] > begin[1] > 0                    # its end has no room
    assert end[0] <= end[1] and end[2] < PHONE[0]     # the end of the name is visible as a whole


# -- commands ---------------------------------------------------------------------------------


def test_a_setting_is_a_form_with_a_slider_beside_the_boards_own_value(control_page, robot):
    form = '[data-service="~settings/arduino/kp"] '
    number, slider = form + 'input[type=number]', form + 'input[type=range]'

    def report(value):
        robot.car.write(arduino.encode_raw(253, b'\1' + struct.pack('<f', value)))

    def value_of(selector):
        text = control_page.script(f"return document.querySelector('{selector}').value")
        return float(text or -1)

    def drag(value):
        control_page.script(
            "const [slider, value] = [document.querySelector(arguments[0]), arguments[1]];"
            "slider.value = value; slider.dispatchEvent(new Event('input'));"
            "slider.dispatchEvent(new Event('change'))", slider, value)

    # Again and again: what is on its way when this machine stalls is dropped.
    control_page.wait(lambda page: page.text(form + '.board-value') == '1.5', 'its own value',
                      doing=lambda: report(1.5), every=0.3)
    control_page.wait(lambda page: (value_of(number), value_of(slider)) == (1.5, 1.5), 'both')
    assert 'proportional gain' in control_page.text(form)
    assert '1/s' in control_page.text(form + 'label')
    wanted = 1, tuple(struct.pack('<f', 2.5))
    press(control_page, form + 'button', lambda _page: wanted in [
        tuple(each) for each in robot.car.messages(SettingMessage)], 'the car gets it',
        lambda _button: drag(2.5))
    wait_for_answer(control_page, 'arduino: kp 2.5 done', doing=lambda: report(2.5), every=0.3)
    control_page.wait(lambda page: page.text(form + '.board-value') == '2.5', 'its new value',
                      doing=lambda: report(2.5), every=0.3)
    assert value_of(number) == 2.5


def test_stop_is_sent_as_soon_as_it_is_pressed_and_once(control_page):
    """A touch that slips or stays, or of a second finger, makes no click."""
    sent = control_page.script("""
        const {send} = WebSocket.prototype, counts = [];
        let count = 0;
        WebSocket.prototype.send = function(text) {
            count += text.includes('"stop"');
            return send.call(this, text);
        };
        for (const part of ['pointerdown', 'click']) {
            document.querySelector('#stop').dispatchEvent(new PointerEvent(part, {button: 0}));
            counts.push(count);
        }
        WebSocket.prototype.send = send;
        return counts;""")
    assert sent == [1, 1]
    release_stop(control_page)


def test_stop_holds_against_another_program_until_it_is_released(control_page, panel, robot):
    page, sent = control_page, []
    moves, zero = (arduino.encode_raw(41, struct.pack('<ff', speed, 0)) for speed in (0.5, 0))
    topic = rospy.Publisher(NODE + '/cmd_vel', Twist, queue_size=1)

    def drive(_event):
        topic.publish(Twist(linear=Vector3(x=0.5)))
        sent.append(time.monotonic())
    driving = rospy.Timer(rospy.Duration(0.05), drive)
    try:
        until(lambda: moves in robot.car.wire, 'another program drives')
        page.click('#stop')
        wait_for_attribute(page, '#stop', 'aria-pressed', 'true')
        until(lambda: zero in robot.car.wire, 'it is stopped')
        with page.other_tab():      # of a panel that only looks
            page.open(panel.url)
            page.wait_for_text('#trouble', 'stopped until STOP is released')
            assert not page.all('.stops button:not([hidden])')
        since = len(sent)
        until(lambda: len(sent) > since + 40, 'the other program continues')
        wire = bytes(robot.car.wire)
        packets = wire[wire.index(zero):].split(b'\0')
        assert {each + b'\0' for each in packets if each[1:2] == zero[1:2]} == {zero}
        release_stop(page)
        robot.car.forget()
        until(lambda: moves in robot.car.wire, 'it drives again')
    finally:
        driving.shutdown()
        topic.unregister()


# -- the dead man's switch --------------------------------------------------------------------


def hold(page, robot):
    """Press the pad above its middle, and hold it until the car drives.

    If the machine stalls for too long, the hold has to end, and another one begins.
    """
    def press():
        if page.attribute('#pad', 'data-held') is None:
            page.release()
            page.press_at('#pad', 0, -60)

    def drives():
        # The page shows the hold a frame later; a test can only see it end if it was shown.
        return any(speed > 0 for speed in robot.car.speeds) \
            and page.attribute('#pad', 'data-held') is not None
    until(drives, 'the car drives', doing=press, every=0.3)


def has_stopped(robot):
    """The bridge's own SPEED 0, after a stall, is followed by the next command of the pad."""
    return robot.car.speeds[-1] == 0 and robot.car.command_frames[-1].stamp < time.monotonic() - 0.3


def wait_until_stopped(robot, page, what=''):
    until(lambda: has_stopped(robot), f'{what}: the car stops')
    page.wait(lambda page: page.attribute('#pad', 'data-held') is None, f'{what}: the hold ends')
    count = len(robot.car.speeds)
    page.wait_for_updates(15)
    assert not any(robot.car.speeds[count:])


@contextlib.contextmanager
def released(page):
    page.release()
    yield


def scripted(text):
    """A context that begins with this JavaScript."""
    @contextlib.contextmanager
    def begun(page):
        page.script(text)
        yield
    return begun


@contextlib.contextmanager
def stopped(page):
    """Another program calls ~stop, and releases it while the pad is still pressed."""
    stop = rospy.ServiceProxy(NODE + '/stop', SetBool)
    stop(True)
    yield
    page.wait(lambda page: page.text('#pad-words') == 'stopped until STOP is released',
              'the hold ends')
    until(lambda: stop(False).success, 'it is released')


def cut(network):
    """A context in which the connection is lost."""
    @contextlib.contextmanager
    def begun(page):
        with network.cut():
            yield
            page.wait_for_text('#connection', 'no connection')
        page.wait_for_text('#connection', 'live')
    return begun


# Each is a context that ends the hold of the pad, and the reason that the page may show.
ENDS = {
    'the pad is released': (released, 'released'),
    'another control gets the focus': (
        scripted("document.getElementById('speed-limit').focus()"), 'the pad has lost the focus'),
    'the window loses the focus': (
        scripted("window.dispatchEvent(new Event('blur'))"), 'the window has lost the focus'),
    'the tab is hidden': (Browser.other_tab, ''),
    'the page hangs': (
        scripted('const end = performance.now() + 1500; while (performance.now() < end);'), ''),
    'the browser is frozen': (Browser.frozen, ''),
    'another program calls ~stop': (stopped, '')}


def test_whatever_ends_a_hold_stops_the_car(control_page, robot, network):
    for what, (end, words) in {**ENDS, 'the connection is lost': (cut(network), '')}.items():
        def ended():
            robot.car.forget()
            hold(control_page, robot)
            with end(control_page):
                until(lambda: has_stopped(robot), f'{what}: the car stops')
            wait_until_stopped(robot, control_page, what)
            control_page.release()
            return words in control_page.text('#pad-words')     # or it ended before, by a stall
        again_if_stalled(ended)
    control_page.errors()       # it was frozen, and without a connection


def test_arrow_keys_drive(control_page, robot):
    control_page.script("document.getElementById('pad').focus()")

    def hold_keys(*keys):
        if control_page.attribute('#pad', 'data-held') is None:      # as in `hold`
            control_page.key_up(UP)
            control_page.key_up(RIGHT)
            for key in keys:
                control_page.key_down(key)
    until(lambda: 200 in robot.car.speeds, 'the car drives', doing=lambda: hold_keys(UP),
          every=0.3)
    control_page.key_down(RIGHT)
    until(lambda: arduino.SteeringCommand(1900) in robot.car.commands(), 'it turns',
          doing=lambda: hold_keys(UP, RIGHT), every=0.3)
    control_page.key_up(RIGHT)
    control_page.key_up(UP)
    wait_until_stopped(robot, control_page)


AHEAD, HELD = 'key down ArrowUp', 'key repeat ArrowUp'
DRIVING, RIGHT_AHEAD = 'speed 200, steering 1500', 'speed 200, steering 1900'
RELEASED, OTHER_KEY = 'stopped: released', 'stopped: another key was pressed'
NO_REPEATS = 'stopped: the key no longer repeats; press it again'


def check_pads(page, expected):
    """Check the words that a pad shows after some steps, and whether it drives."""
    found = page.script_until_done(read_script('pads'), list(expected))
    assert dict(zip(expected, found)) == {
        steps: [words, words.startswith('speed'), words.startswith('speed')]
        for steps, words in expected.items()}


def test_which_keys_drive_and_what_else_stops(page):
    """Whether keys and pad reach the car: test_arrow_keys_drive and those before it."""
    check_pads(page, {
        AHEAD: DRIVING, f'{AHEAD}, key down ArrowRight': RIGHT_AHEAD,
        f'{AHEAD}, key down ArrowRight, key up ArrowRight': DRIVING,
        f'{AHEAD}, key up ArrowUp': RELEASED,
        # Keys of the keypad: with NumLock and Shift, one can be pressed as an arrow and released as
        # the digit 8. With a modifier: macOS does not report the release while Cmd is held.
        'key down shift+Numpad8, key up ShiftLeft, key up Numpad8': 'hold to drive',
        'key down meta+ArrowUp': 'hold to drive', 'key down shift+ArrowUp': 'hold to drive',
        # Any other key stops, and one that is still held and repeats does not drive again.
        f'{AHEAD}, key down meta+MetaLeft, {HELD}': OTHER_KEY,
        f'{AHEAD}, key down KeyX, {HELD}': OTHER_KEY,
        f'{AHEAD}, key up Numpad8, {HELD}': RELEASED,
        # Pad and keys do not drive together.
        f'pointer down, {AHEAD}': 'stopped: a key was pressed while the pad was held',
        f'{AHEAD}, pointer down': 'stopped: pressed while a key was held',
        # A key that no longer repeats counts as released; also one that never begins to, on a
        # system that is known to repeat keys.
        f'{AHEAD}, {HELD}, wait 450': DRIVING, f'{AHEAD}, {HELD}, wait 1050': NO_REPEATS,
        f'{AHEAD}, {HELD}, key up ArrowUp, {AHEAD}, wait 2450': DRIVING,
        f'{AHEAD}, {HELD}, key up ArrowUp, {AHEAD}, wait 3050': NO_REPEATS,
        # Systems that repeat no keys, or only the one pressed last, and none after its release.
        f'{AHEAD}, wait 20000': DRIVING,
        f'{AHEAD}, {HELD}, key down ArrowRight, key repeat ArrowRight, key up ArrowRight, '
        'wait 20000': DRIVING})


# -- outages ----------------------------------------------------------------------------------


def test_the_page_shows_a_restart_of_the_bridge(page, robot):
    wait_for_attribute(page, '[data-link="bus"]', 'data-health', 'ok')
    robot.bridge.end()
    page.wait(lambda page: 'no bridge ' + NODE in page.text('#trouble'), 'the page shows it')
    # A warning if this machine stalled just before.
    assert page.attribute('[data-link="bus"]', 'data-health') in ('none', 'ok', 'warn')
    wait_for_attribute(page, '[data-link="bus"]', 'data-health', 'none')
    robot.start_bridge()
    page.wait(lambda page: page.text('#trouble') == '', 'the trouble is over')
    wait_for_attribute(page, '[data-link="bus"]', 'data-health', 'ok')
    wait_for_attribute(page, '[data-reading="~imu:roll"]', 'data-state', 'fresh')


def test_the_page_shows_a_restart_of_the_master(control_page, robot, core):
    page = control_page
    alarms = watch_texts(page, '#alarm')
    core.stop()
    page.wait(lambda page: 'no answer from the ROS master' in page.text('#trouble'),
              'the page shows it')
    page.wait_for_text('#connection', 'not live')
    page.wait(lambda page: 'no answer from the ROS master' in page.text(
        '[data-service="~lift"] .reason'), 'the reason is shown')
    assert not page.all('[data-service="~lift"] button')[0].is_enabled()
    shown = page.text('#trouble')
    page.wait(lambda page: page.text('#trouble') not in ('', shown), 'its age counts up')
    # A screen reader hears of it once, without the age that changes ten times a second; again
    # after this machine has stalled the panel.
    shown = [each for each in alarms() if each]
    stalls = [each for each in shown if 'no connection to the panel' in each]
    others = [each for each in shown if each not in stalls]
    assert len(others) <= 1 + len(stalls) and len(set(others)) == 1
    assert 'no answer from the ROS master' in others[0]
    core.start()
    page.wait(lambda page: page.text('#trouble') == '', 'the trouble is over')
    page.wait_for_text('#connection', 'live')
    # A new subscription works with the new master, too.
    page.click('#card-wire > summary')
    page.wait(lambda page: page.all('.frame'), 'serial_msg is received')
    page.click('#card-wire > summary')
    page.errors()       # the panel starts again, too, and refuses connections for a moment


def serve(content):
    """Another site, with one page."""
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header('Content-Type', 'text/html')
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_arguments):
            pass

    # Threads: chromium opens a second connection in advance, on which nothing comes for a minute.
    server = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def test_a_page_of_another_site_can_neither_connect_nor_embed(chromium, panel):
    evil = f'''<title>evil</title><script>
      const socket = new WebSocket('ws://127.0.0.1:{panel.port}/socket');
      socket.onopen = () => document.title = 'open';
      socket.onerror = () => document.title = 'refused';
    </script><iframe src="http://127.0.0.1:{panel.port}/"></iframe>'''.encode()

    server = serve(evil)
    chromium.open(f'http://localhost:{server.server_port}/')
    chromium.wait(lambda page: page.title == 'refused', 'the connection is refused')
    chromium.driver.switch_to.frame(chromium.all('iframe')[0])
    assert not chromium.all('#node')
    chromium.driver.switch_to.default_content()
    # Nor through a name that resolves to this machine.
    chromium.open(f'http://rebinding.example:{panel.port}/')
    assert 'is not a name of this machine' in chromium.text('body')
    server.shutdown()
    chromium.errors()


def test_the_page_needs_the_token_once(chromium, control_panel, panel):
    chromium.open(control_panel.url.split('#')[0])
    chromium.script('localStorage.clear()')
    chromium.open('about:blank')
    chromium.open(control_panel.url.split('#')[0])
    chromium.wait(lambda page: 'open the address that the panel printed' in page.text(
        '#trouble'), 'the page shows it')
    # A wrong one is told so; the reason stays while the page tries again.
    reasons = watch_texts(chromium, '#trouble')
    chromium.script("location.hash = 'not-the-right-one'")
    chromium.wait(lambda _page: 'its token is wrong' in reasons()[-1], 'the page shows it')
    seen = len(reasons())
    tries = ("return performance.getEntriesByType('resource')"
             ".filter((each) => each.name.endsWith('/key')).length")
    before = chromium.script(tries)
    chromium.wait(lambda page: page.script(tries) > before + 2, 'it tries again')
    assert reasons()[seen - 1:] == ['its token is wrong; '
                                    'open the address that the panel printed']
    chromium.errors()
    chromium.open(control_panel.url)        # in the same tab: only the part after # changes
    chromium.wait_for_text('#connection', 'live')
    assert chromium.script('return location.href') == control_panel.url.split('#')[0]
    history = chromium.driver.execute_cdp_cmd('Page.getNavigationHistory', {})['entries']
    assert not any(TOKEN in entry['url'] for entry in history)
    chromium.open('about:blank')
    chromium.open(control_panel.url.split('#')[0])
    chromium.wait_for_text('#connection', 'live')
    # Nothing of it is sent to another port of this machine.
    assert chromium.driver.get_cookies() == []
    chromium.open(panel.url)
    chromium.wait_for_text('#connection', 'live')
    assert chromium.script('return localStorage.length') == 0
    chromium.errors()
