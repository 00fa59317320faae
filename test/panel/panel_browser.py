"""Headless Chromium, controlled through its driver."""
import base64
import contextlib
import tempfile

from boards import PATIENCE, until
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException, WebDriverException
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By

_FLAGS = ('--headless=new', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
          '--disable-background-networking', '--disable-component-update', '--disable-sync',
          '--disable-dev-shm-usage', '--hide-scrollbars')


class Browser:
    """One window of a browser with an empty profile; `driver` is its driver."""

    def __init__(self, width=1600, height=1000):
        self._profile = tempfile.TemporaryDirectory(prefix='panel_browser_')
        options = Options()
        for flag in (*_FLAGS, f'--window-size={width},{height}',
                     f'--user-data-dir={self._profile.name}'):
            options.add_argument(flag)
        options.binary_location = '/usr/bin/chromium'
        options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
        self.driver = webdriver.Chrome(options=options,
                                       service=Service('/usr/bin/chromedriver'))
        self.resize(width, height)

    def quit(self):
        with contextlib.suppress(WebDriverException):    # it was killed
            self.driver.quit()

        def is_deleted():
            try:
                self._profile.cleanup()
            except OSError:     # a process of the browser that ends last has written into it
                return False
            return True
        until(is_deleted, 'its profile is deleted')

    def open(self, url):
        self.driver.get(url)

    def resize(self, width, height):
        """Set the size of the page in CSS pixels."""
        self.driver.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', {
            'width': width, 'height': height, 'deviceScaleFactor': 1,
            'mobile': width < 600})

    # -- content ---------------------------------------------------------------------------

    def script(self, text, *arguments):
        return self.driver.execute_script(text, *arguments)

    def all(self, selector):
        return self.driver.find_elements(By.CSS_SELECTOR, selector)

    def text(self, selector):
        """The text of the first element that matches; empty if none does."""
        return self.script("return document.querySelector(arguments[0])?.innerText ?? ''",
                           selector).strip()

    def texts(self, selector):
        """The text of every element that matches."""
        return self.script("return [...document.querySelectorAll(arguments[0])]"
                           ".map(each => each.innerText)", selector)

    def picture(self):
        """A PNG of the visible page."""
        shot = self.driver.execute_cdp_cmd('Page.captureScreenshot', {'format': 'png'})
        return base64.b64decode(shot['data'])

    def attribute(self, selector, name):
        """An attribute of the first element that matches; None if none does."""
        return self.script(
            "return document.querySelector(arguments[0])?.getAttribute(arguments[1])",
            selector, name)

    def wait(self, condition, what, seconds=PATIENCE, doing=None, every=0.05):
        """Wait for `condition(self)`; call `doing` repeatedly until then."""
        def holds():
            try:
                return condition(self)
            except StaleElementReferenceException:
                return False
        try:
            return until(holds, what, seconds, doing, every)
        except AssertionError as error:
            raise AssertionError(f'{error}; its answers are {self.texts(".answers li")}, '
                                 f'its pad says {self.text("#pad-words")!r}') from None

    def wait_for_text(self, selector, text):
        """Wait until the first element that matches has this text."""
        shown = []

        def holds():
            shown[:] = [self.text(selector)]
            return shown == [text]
        try:
            until(holds, every=0.05)
        except AssertionError:
            raise AssertionError(f'{selector} shows {shown[0]!r}, not {text!r}') from None

    def errors(self):
        """The warnings and errors in the console since the last call."""
        return [entry for entry in self.driver.get_log('browser')
                if entry['level'] in ('SEVERE', 'WARNING')]

    # -- input -----------------------------------------------------------------------------

    def _actions(self):
        """Mouse and keys; a movement takes 10 ms instead of 250 ms."""
        return ActionChains(self.driver, duration=10)

    def click(self, selector):
        """Click it once it is shown: the page may still be laid out."""
        until(lambda: self.all(selector)[0].is_displayed(), f'{selector} is shown')
        self.all(selector)[0].click()

    def press_at(self, selector, right, down):
        """Press and hold the mouse at this offset in px from the middle of the element."""
        element = self.all(selector)[0]
        self.script("arguments[0].scrollIntoView({block: 'center'})", element)
        self._actions().move_to_element_with_offset(
            element, right, down).click_and_hold().perform()

    def release(self):
        self._actions().release().perform()

    def key(self, what, name, number):
        """Press or release a key (Down or Up), by its name and its Windows key code."""
        self.driver.execute_cdp_cmd('Input.dispatchKeyEvent', {
            'type': f'key{what}', 'key': name, 'code': name, 'windowsVirtualKeyCode': number})

    @contextlib.contextmanager
    def other_tab(self):
        """Inside this block, another tab is in front."""
        here = self.driver.current_window_handle
        self.driver.switch_to.new_window('tab')
        try:
            yield
        finally:
            self.driver.close()
            self.driver.switch_to.window(here)
