"""The guard checks Host and Origin of a request, the entrance its token."""
import pytest
from serial_communication.tools.panel.guard import Entrance, Guard, is_loopback

NAMES = ['Robot', 'robot.local']
GUARD = Guard('0.0.0.0', NAMES)
LOOPBACK = Guard('127.0.0.1', NAMES)


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


@pytest.mark.parametrize('host', ['127.0.0.1:8080', 'localhost:8080', '127.3.2.1', '[::1]:80'])
def test_on_loopback_its_addresses_and_localhost_are_allowed(host):
    assert LOOPBACK.check_host(host) == GUARD.check_host(host) == ''


@pytest.mark.parametrize('host', ['robot', 'ROBOT.local:8080', '192.168.1.7', '0.0.0.0',
                                  '[fe80::1]'])
def test_on_loopback_no_other_name_or_address_of_this_machine_is_allowed(host):
    assert 'is not a name of this machine on loopback' in LOOPBACK.check_host(host)
    assert GUARD.check_host(host) == ''


@pytest.mark.parametrize('origin, same', [
    ('http://robot:8080', True), ('https://ROBOT:8080', True), ('http://robot:8081', False),
    ('http://robot', False), ('http://evil.example', False), ('null', False), ('', False),
    ('http://[', False), (None, False)])
def test_only_pages_of_the_same_host_and_port_are_allowed(origin, same):
    assert (GUARD.check_origin(origin, 'robot:8080') == '') == same


def test_only_the_token_gets_in():
    entrance = Entrance('a-token-of-the-tests')
    assert entrance.check('a-token-of-the-tests') == ''
    for wrong in 'a-token-of-the-test', 'a-token-of-the-tests ', '\udcff':
        assert entrance.check(wrong) == 'its token is wrong'
    assert entrance.check(None) == entrance.check('') == 'it has no token'


def test_without_a_token_every_page_may_connect():
    entrance = Entrance(None)
    assert entrance.check(None) == entrance.check('any') == ''


@pytest.mark.parametrize('address, loopback', [
    ('127.0.0.1', True), ('localhost', True), ('::1', True), ('127.3.2.1', True),
    ('0.0.0.0', False), ('192.168.1.7', False), ('robot', False), ('', False)])
def test_is_loopback(address, loopback):
    assert is_loopback(address) == loopback
