"""A port that cannot be opened is reported in plain words, not in pyserial's."""
import errno
import socket
import termios

import pytest
import serial

from serial_communication.transport.port_errors import explain
from serial_communication.transport.urls import check_url

NETWORK = '{0}:// takes a host, a port and options of pyserial, as in {0}://192.168.1.5:4001'


@pytest.mark.parametrize('url, words', [
    *((url, NETWORK.format('socket')) for url in (
        'socket://robot', 'socket://robot:', 'socket://127.0.0.1:99999', 'socket://127.0.0.1:0',
        'socket://127.0.0.1:-1', 'socket://127.0.0.1:http', 'socket://:4001', 'socket://',
        'Socket://:4001', 'socket://robot:4001?loging=debug', 'socket://robot:4001?logging=loud')),
    *((url, NETWORK.format('rfc2217')) for url in (
        'rfc2217://robot', 'rfc2217://robot:99999', 'rfc2217://robot:4001?timeout=soon',
        'RFC2217://x')),
    ('hwgrep://(', 'hwgrep:// takes a regular expression'),
    ('nosuch://robot', "protocol 'nosuch' not known"),
])
def test_an_invalid_url_is_refused(url, words):
    with pytest.raises(ValueError) as refusal:
        check_url(url)
    assert words in str(refusal.value)


@pytest.mark.parametrize('url', ['', '/dev/ttyS0', 'socket://robot:4001', 'socket://[::1]:4001',
                                 'rfc2217://robot:4001', 'rfc2217://robot:4001?ign_set_control',
                                 'rfc2217://robot:4001?poll_modem&timeout=3', 'loop://',
                                 'hwgrep://0403:6001', 'spy:///dev/ttyS0'])
def test_a_valid_url_is_accepted(url):
    check_url(url)


@pytest.mark.parametrize('url, words', [
    ('socket://no-such-host.invalid:4001', 'no host of that name is known'),
    ('Hwgrep://nothing-of-that-name', 'no device matches; waiting for one'),
    ('socket://127.0.0.1:{}', 'connection refused; does the server run, and is its port right?'),
    ('rfc2217://127.0.0.1:{}', 'connection refused; does the server run, and is its port right?')])
def test_a_port_that_cannot_be_opened_is_reported_in_plain_words(url, words, refusal):
    with socket.socket() as bound:      # nobody listens there
        bound.bind(('127.0.0.1', 0))
        assert refusal(url.format(bound.getsockname()[1])) == words


def test_a_server_that_does_not_speak_rfc2217_is_reported(refusal):
    with socket.create_server(('127.0.0.1', 0)) as listener:
        url = f'rfc2217://127.0.0.1:{listener.getsockname()[1]}?timeout=0.1'
        assert refusal(url) == ('the other side does not speak RFC 2217; socket:// is for a plain '
                                'TCP connection')


def wrapped(inner):
    """An error of the system in one of pyserial's, as pyserial raises it."""
    try:
        try:
            raise inner
        except type(inner) as error:
            raise serial.SerialException(f'Could not configure port: {error}')
    except serial.SerialException as error:
        return error


def not_open():
    """The error that pyserial raises for a closed port; its class has no name before 3.5."""
    with pytest.raises(serial.SerialException) as error:
        serial.Serial().read()
    return error.value


@pytest.mark.parametrize('error, words', [
    (wrapped(termios.error(errno.EIO, 'Input/output error')), 'the device has gone'),
    (wrapped(OSError(errno.EACCES, 'Permission denied')), 'permission denied'),
    (wrapped(socket.timeout('timed out')), 'the host does not answer'),
    (wrapped(OSError(errno.EHOSTUNREACH, 'No route to host')), 'the host cannot be reached'),
    (serial.SerialException('socket disconnected'), 'the other side closed the connection'),
    (serial.SerialException('connection failed (reader thread died)'),
     'the other side closed the connection'),
    (not_open(), 'the device has gone'),
])
def test_an_error_of_the_system_is_reported_in_plain_words(error, words):
    assert explain(error).startswith(words)
