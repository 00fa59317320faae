"""The server, without a browser and without ROS; the clock is the test's."""
import asyncio
import json
from types import SimpleNamespace
from unittest import mock

import pytest
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.testing import AsyncHTTPTestCase, gen_test
from tornado.websocket import websocket_connect

from serial_communication.tools.panel.driving import CommandRefused
from serial_communication.tools.panel.news import News
from serial_communication.tools.panel.pages import Hub, Page
from serial_communication.tools.panel.server import application, is_of, is_own

NAMES = {'0.0.0.0', 'robot', 'robot.local'}
TOKEN = 'a-token-of-the-tests'


class ServerTest(AsyncHTTPTestCase):
    """A server whose clock stands, with pages that read and acknowledge what the test says."""

    def get_app(self):
        self.now, self.news = 100.0, News()
        self.commands = mock.Mock()
        self.hub = Hub(SimpleNamespace(want=mock.Mock(), update=mock.Mock()), self.commands,
                       self.news, mock.Mock(), lambda: self.now)
        self.news.tell('state', 'node', '/bridge')
        return application(Page, self.hub, (), TOKEN, self.get_http_port())

    def request(self, path, **headers):
        """GET with these headers; a body in `body`: POST. The status, headers and body."""
        body = headers.pop('body', None)
        return self.fetch(path, method='GET' if body is None else 'POST', body=body,
                          headers={name.replace('_', '-'): each for name, each in headers.items()})

    @property
    def host(self):
        return f'127.0.0.1:{self.get_http_port()}'

    def cookie(self):
        answer = self.request('/token', body=TOKEN, Origin=f'http://{self.host}')
        assert answer.code == 200
        return answer.headers['Set-Cookie'].split(';')[0]

    async def connect(self, cookie, **headers):
        return await websocket_connect(HTTPRequest(f'ws://{self.host}/socket', headers={
            'Origin': f'http://{self.host}', 'Cookie': cookie, **headers}))

    async def update(self, page, seconds=0.05):
        """A tick; the update that the page gets, which it does not acknowledge."""
        self.now += seconds
        self.hub.tick()
        return json.loads(await page.read_message())

    async def say(self, page, **message):
        """Send a message, and wait until the server has taken it."""
        sent = self.hub.log.mock_calls[:]
        await page.write_message(json.dumps(message))
        await page.write_message(json.dumps({'stop': {'key': 'done'}}))
        while mock.call.stop('done') not in self.commands.mock_calls:
            await asyncio.sleep(0.001)
        self.commands.stop.reset_mock()
        return self.hub.log.mock_calls[len(sent):]


class EntranceTest(ServerTest):
    def test_the_policy_forbids_foreign_and_inline_content(self):
        answer = self.request('/')
        assert answer.code == 200 and b'<title>' in answer.body
        assert 'Set-Cookie' not in answer.headers
        policy = answer.headers['Content-Security-Policy']
        for rule in ("default-src 'none'", "script-src 'self'", "frame-ancestors 'none'",
                     "base-uri 'none'", "require-trusted-types-for 'script'"):
            assert rule in policy
        assert 'unsafe' not in policy and '*' not in policy
        assert answer.headers['X-Content-Type-Options'] == 'nosniff'

    def test_foreign_hosts_and_origins_are_refused(self):
        for headers in ({'Host': 'evil.example'}, {'Host': 'robot'}, {'Host': '192.168.1.7'},
                        {'Origin': 'http://evil.example'}, {'Origin': 'null'}):
            assert self.request('/', **headers).code == 403
            assert self.request('/token', body=TOKEN,
                                **{'Origin': f'http://{self.host}', **headers}).code == 403
        assert self.request('/token', body=TOKEN).code == 403
        assert self.request('/', Origin=f'http://{self.host}').code == 200

    def test_the_token_gives_a_cookie_named_after_the_port(self):
        answer = self.request('/token', body='not-the-right-one', Origin=f'http://{self.host}')
        assert answer.code == 401 and 'Set-Cookie' not in answer.headers
        assert self.cookie().startswith(f'panel_{self.get_http_port()}=')

    @gen_test
    async def test_a_connection_needs_cookie_host_and_origin(self):
        for headers in {'Origin': 'http://evil.example'}, {'Host': 'evil.example'}:
            with pytest.raises(HTTPClientError, match='403'):
                await self.connect('', **headers)
        page = await self.connect(f'panel_{self.get_http_port()}=in')
        assert await page.read_message() is None and 'token' in page.close_reason
        assert not self.hub.pages


class PagesTest(ServerTest):
    def setUp(self):
        super().setUp()
        self.given = self.cookie()

    @gen_test
    async def test_a_page_is_told_everything_then_what_is_new(self):
        page = await self.connect(self.given)
        first = await self.update(page)
        assert first['control'] is True and first['state'] == {'node': '/bridge'}
        await self.say(page, seen=first['now'])
        self.news.tell('samples', '~ticks', [1, 2])
        second = await self.update(page)
        assert second['samples'] == {'~ticks': [1, 2]} and 'state' not in second

    @gen_test
    async def test_a_page_that_is_frozen_gets_nothing_and_then_the_newest(self):
        page = await self.connect(self.given)
        await self.update(page)
        for number in range(1000):
            self.news.tell('samples', '~ticks', [number])
            self.now += 0.05
            self.hub.tick()
        await self.say(page, seen=100.05)
        self.hub.tick()
        newest = json.loads(await page.read_message())
        assert newest['samples'] == {'~ticks': [999]} and newest['now'] == pytest.approx(self.now)

    @gen_test
    async def test_frames_are_for_pages_that_show_the_wire(self):
        page = await self.connect(self.given)
        first = await self.update(page)
        self.news.add('frames', 'a frame', 10)
        await self.say(page, seen=first['now'])
        second = await self.update(page)
        assert 'frames' not in second and not next(iter(self.hub.pages)).shows_wire
        await self.say(page, seen=second['now'], wire=True)
        self.news.add('frames', 'another', 10)
        assert list((await self.update(page))['frames'].values()) == ['another']

    @gen_test
    async def test_commands_reach_the_robot_with_the_age_of_what_the_page_has_seen(self):
        page = await self.connect(self.given)
        first = await self.update(page)
        await self.say(page, seen=first['now'], drive={'hold': 3, 'values': {'~x': {'y': 1}}})
        one, = self.hub.pages
        self.commands.drive.assert_called_once_with(one, 3, first['now'], {'~x': {'y': 1}})
        await self.say(page, send={'key': 'k', 'name': '~lift', 'values': {}}, go={'key': 'g'})
        self.commands.send.assert_called_once_with('k', first['now'], '~lift', {})
        self.commands.go.assert_called_once_with('g', first['now'])
        await self.say(page, release={'hold': 3})
        self.commands.switch.release.assert_called_once_with(one, 3)
        page.close()
        while not self.commands.switch.forget.called:
            await asyncio.sleep(0.001)
        assert not self.hub.pages

    @gen_test
    async def test_what_is_refused_is_told_with_its_key(self):
        page = await self.connect(self.given)
        self.commands.send.side_effect = CommandRefused('too old')
        await self.say(page, send={'key': 'k', 'name': '~lift', 'values': {}})
        assert json.loads(await page.read_message()) == {
            'refused': {'key': 'k', 'words': 'too old'}}
        self.hub.commands = None
        await page.write_message(json.dumps({'stop': {'key': 's'}}))
        assert 'read-only' in json.loads(await page.read_message())['refused']['words']

    @gen_test
    async def test_an_invalid_message_ends_the_connection(self):
        for text in ('x', '[1]', '{"seen": NaN}', '{"seen": 1e999}', '{"drive": 5}',
                     '{"drive": {"hold": "x"}}', '{"send": {"key": "k"}}', '[' * 10000, b'\xff'):
            page = await self.connect(self.given)
            await page.write_message(text, binary=isinstance(text, bytes))
            assert await page.read_message() is None
            assert page.close_reason == 'it sent an invalid message', text
        assert not self.hub.pages

    @gen_test
    async def test_a_panel_that_fails_says_so_on_every_page(self):
        page = await self.connect(self.given)
        self.hub._feed.update.side_effect = RuntimeError
        assert 'has failed' in (await self.update(page))['state']['trouble']


@pytest.mark.parametrize('names, host, allowed', [
    *((NAMES, host, True) for host in (
        '127.0.0.1:8080', 'localhost:8080', 'LOCALHOST', '[::1]:8080', '192.168.1.7', 'robot:80',
        'ROBOT.local:8080', 'localhost.:8080')),
    *((NAMES, host, False) for host in ('evil.example', 'robot.evil.example', '', '[', 'x y')),
    *(((), host, True) for host in ('127.0.0.1', 'localhost:1', '[::1]')),
    *(((), host, False) for host in ('robot', '192.168.1.7', 'evil.example'))])
def test_only_names_of_this_machine_are_hosts(names, host, allowed):
    assert is_own(host, names) is allowed


@pytest.mark.parametrize('origin, host, same', [
    ('http://robot:8080', 'robot:8080', True), ('http://ROBOT', 'robot', True),
    ('http://robot:8081', 'robot:8080', False), ('null', 'robot', False), (None, 'robot', False),
    ('http://evil.example', 'robot', False), ('http://[', 'robot', False)])
def test_only_a_page_of_the_host_is_its_own(origin, host, same):
    assert is_of(origin, host) is same
