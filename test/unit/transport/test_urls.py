"""URLs of ports are checked before a port is opened."""
import pytest

from serial_communication.transport.port import Port
from serial_communication.transport.urls import check_url, read_url


@pytest.mark.parametrize('url', [
    'socket://robot', 'socket://robot:', 'socket://127.0.0.1:99999', 'socket://127.0.0.1:0',
    'socket://127.0.0.1:-1', 'socket://127.0.0.1:http', 'socket://:4001', 'socket://',
    'socket://robot:4001?loging=debug', 'socket://robot:4001?logging=loud', 'rfc2217://robot',
    'rfc2217://robot:99999', 'rfc2217://robot:4001?timeout=soon', 'RFC2217://x', 'Socket://:4001',
    'hwgrep://(', 'nosuch://robot'])
def test_an_invalid_url_is_refused(url):
    with pytest.raises(ValueError):
        check_url(url)


@pytest.mark.parametrize('url', ['', '/dev/ttyS0', 'socket://robot:4001', 'socket://[::1]:4001',
                                 'rfc2217://robot:4001', 'rfc2217://robot:4001?ign_set_control',
                                 'rfc2217://robot:4001?poll_modem&timeout=3', 'loop://',
                                 'hwgrep://0403:6001', 'spy:///dev/ttyS0'])
def test_a_valid_url_is_accepted(url):
    check_url(url)


@pytest.mark.parametrize('url, lower, scheme', [
    ('SOCKET://Host:1', 'socket://Host:1', 'socket'), ('Rfc2217://h:1', 'rfc2217://h:1', 'rfc2217'),
    ('Hwgrep://0403:6001', 'hwgrep://0403:6001', 'hwgrep'), ('LOOP://', 'loop://', 'loop'),
    ('/dev/ttyUSB0', '/dev/ttyUSB0', ''), ('/tmp/SOCKET:x', '/tmp/SOCKET:x', '')])
def test_a_scheme_is_the_same_in_any_case(url, lower, scheme):
    assert read_url(url) == (lower, scheme)
    assert Port(url).is_network == (scheme in ('socket', 'rfc2217'))
