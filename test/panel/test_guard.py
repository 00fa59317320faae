"""Host, Origin and token: what a request has to show."""
import pytest
from serial_communication.tools.panel.guard import Guard, is_loopback

GUARD = Guard(['Robot', 'robot.local'], 'a-token-of-the-tests')


@pytest.mark.parametrize('host', [
    '127.0.0.1:8080', 'localhost:8080', 'LOCALHOST', '[::1]:8080', '192.168.1.7', 'robot:80',
    'ROBOT.local:8080', 'localhost.:8080'])
def test_hosts_that_are_ours(host):
    assert GUARD.refuse_host(host) == ''


@pytest.mark.parametrize('host', [
    'evil.example', 'evil.example:8080', '127.0.0.1.evil.example', 'localhost.evil.example', '',
    'robot.evil', '[::1', '::::', 'localhost@evil.example', '127.1.evil', 'ro bot'])
def test_hosts_of_others(host):
    assert 'is no name of this machine' in GUARD.refuse_host(host)


@pytest.mark.parametrize('origin, same', [
    ('http://robot:8080', True), ('https://ROBOT:8080', True), ('http://robot:8081', False),
    ('http://robot', False), ('http://evil.example', False), ('null', False), ('', False),
    ('http://[', False), (None, False)])
def test_origins(origin, same):
    assert (GUARD.refuse_origin(origin, 'robot:8080') == '') == same


def test_tokens():
    assert GUARD.refuse_token('a-token-of-the-tests') == ''
    assert GUARD.refuse_token(None, 'a-token-of-the-tests') == ''
    assert GUARD.refuse_token('old', 'a-token-of-the-tests') == ''
    assert GUARD.refuse_token('a-token-of-the-test') == 'the token is wrong'
    assert GUARD.refuse_token('\udcff') == 'the token is wrong'
    assert GUARD.refuse_token(None, None) == GUARD.refuse_token('') == 'it shows no token'
    assert Guard([], None).refuse_token(None) == ''


@pytest.mark.parametrize('address, alone', [
    ('127.0.0.1', True), ('localhost', True), ('::1', True), ('127.3.2.1', True),
    ('0.0.0.0', False), ('192.168.1.7', False), ('robot', False), ('', False)])
def test_addresses_that_only_this_machine_reaches(address, alone):
    assert is_loopback(address) == alone
