"""The guard checks Host, Origin and token of a request."""
import pytest
from serial_communication.tools.panel.guard import Guard, is_loopback

GUARD = Guard(['Robot', 'robot.local'], 'a-token-of-the-tests')


@pytest.mark.parametrize('host', [
    '127.0.0.1:8080', 'localhost:8080', 'LOCALHOST', '[::1]:8080', '192.168.1.7', 'robot:80',
    'ROBOT.local:8080', 'localhost.:8080'])
def test_addresses_and_names_of_this_machine_are_allowed(host):
    assert GUARD.check_host(host) == ''


@pytest.mark.parametrize('host', [
    'evil.example', 'evil.example:8080', '127.0.0.1.evil.example', 'localhost.evil.example', '',
    'robot.evil', '[::1', '::::', 'localhost@evil.example', '127.1.evil', 'ro bot'])
def test_names_of_other_machines_are_refused(host):
    assert 'is not a name of this machine' in GUARD.check_host(host)


@pytest.mark.parametrize('origin, same', [
    ('http://robot:8080', True), ('https://ROBOT:8080', True), ('http://robot:8081', False),
    ('http://robot', False), ('http://evil.example', False), ('null', False), ('', False),
    ('http://[', False), (None, False)])
def test_only_pages_of_the_same_host_and_port_are_allowed(origin, same):
    assert (GUARD.check_origin(origin, 'robot:8080') == '') == same


def test_only_the_right_token_is_allowed():
    assert GUARD.check_token('a-token-of-the-tests') == ''
    assert GUARD.check_token(None, 'a-token-of-the-tests') == ''
    assert GUARD.check_token('old', 'a-token-of-the-tests') == ''
    assert GUARD.check_token('a-token-of-the-test') == 'the token is wrong'
    assert GUARD.check_token('\udcff') == 'the token is wrong'
    assert GUARD.check_token(None, None) == GUARD.check_token('') == 'it has no token'
    assert Guard([], None).check_token(None) == ''


@pytest.mark.parametrize('address, loopback', [
    ('127.0.0.1', True), ('localhost', True), ('::1', True), ('127.3.2.1', True),
    ('0.0.0.0', False), ('192.168.1.7', False), ('robot', False), ('', False)])
def test_is_loopback(address, loopback):
    assert is_loopback(address) == loopback
