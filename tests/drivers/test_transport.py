"""Real sockets and pseudo terminals on this machine."""

import errno
import io
import os
import pty
import socket
import termios
import threading
import tty
from contextlib import suppress

import pytest

from drivers import transport
from drivers.errors import TransportError
from drivers.transport import SerialTransport, TcpTransport


@pytest.fixture
def listener():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5.0)
        yield server


@pytest.fixture
def tcp(listener):
    """Both ends of one connection: our transport and the peer's socket."""
    with TcpTransport(*listener.getsockname()) as transport:
        peer, _ = listener.accept()
        with peer:
            yield transport, peer


@pytest.fixture
def terminal():
    """The master's descriptor and the path of a pseudo terminal."""
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    path = os.ttyname(slave)
    os.close(slave)
    yield master, path
    os.close(master)


def test_tcp_carries_bytes_in_both_directions(tcp):
    transport, peer = tcp
    transport.write(b"to")
    assert peer.recv(10) == b"to"
    peer.sendall(b"fro")
    assert transport.read(5.0) == b"fro"


def test_tcp_read_returns_nothing_when_nothing_came(tcp):
    assert tcp[0].read(0.001) == b""


def test_tcp_does_not_wait_for_more_and_notices_dead_peers(listener, monkeypatch):
    connect, made = socket.create_connection, []
    monkeypatch.setattr(socket, "create_connection", lambda *a, **k: made.append(connect(*a, **k)) or made[0])
    with TcpTransport(*listener.getsockname()):
        assert made[0].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert made[0].getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert made[0].getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 3_000


def test_tcp_peer_that_closes_is_a_transport_error(tcp):
    transport, peer = tcp
    peer.close()
    with pytest.raises(TransportError, match=r"127\.0\.0\.1:\d+ closed the connection"):
        transport.read(5.0)


def test_tcp_peer_that_resets_is_a_transport_error(tcp):
    transport, peer = tcp
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
    peer.close()
    with pytest.raises(TransportError, match="reset"):
        transport.read(5.0)


def test_tcp_write_after_the_end_is_a_transport_error(tcp):
    transport, _ = tcp
    transport.close()
    with pytest.raises(TransportError, match="cannot send 3 bytes"):
        transport.write(b"abc")


def test_serial_carries_bytes_in_both_directions(terminal):
    master, path = terminal
    with SerialTransport(path, 115_200) as port:
        port.write(b"to")
        assert os.read(master, 10) == b"to"
        os.write(master, b"fro")
        assert port.read(5.0) == b"fro"
        assert port.read(0.001) == b""


@pytest.mark.parametrize("call", ["tcsetattr", "tcflush"])
def test_serial_port_that_goes_away_while_it_is_opened_is_a_transport_error(terminal, monkeypatch, call):
    """An adapter that enumerates again: termios.error is no OSError, and would end the reader's thread."""

    def gone(*_):
        raise termios.error(errno.EIO, "Input/output error")

    _, path = terminal
    monkeypatch.setattr(termios, call, gone)
    with pytest.raises(TransportError, match=r"cannot open .*Input/output error"):
        SerialTransport(path, 115_200)


def test_serial_port_that_goes_away_while_its_rate_is_set_is_a_transport_error(terminal, monkeypatch):
    def gone(*_):
        raise termios.error(errno.EIO, "Input/output error")

    with SerialTransport(terminal[1], 115_200) as port:
        monkeypatch.setattr(termios, "tcsetattr", gone)
        with pytest.raises(TransportError, match="cannot go to 9600 baud"):
            port.set_baud(9600)


def test_tcp_host_that_is_no_name_is_a_transport_error():
    with pytest.raises(TransportError, match=r"cannot connect to .*label"):
        TcpTransport("a" * 64, 2111)


def test_serial_port_opened_twice_is_refused(terminal):
    _, path = terminal
    with SerialTransport(path, 115_200), pytest.raises(TransportError) as refused:
        SerialTransport(path, 115_200)
    assert str(refused.value) == f"cannot open {path} at 115200 baud: another program has it open"


def test_serial_port_that_is_not_there_is_named_once_and_without_numbers(tmp_path):
    with pytest.raises(TransportError) as refused:
        SerialTransport(str(tmp_path / "port"), 9600)
    assert str(refused.value) == f"cannot open {tmp_path}/port at 9600 baud: No such file or directory"


def test_a_file_that_is_no_serial_port_is_named_so():
    with pytest.raises(TransportError) as refused:
        SerialTransport("/dev/null", 9600)
    assert str(refused.value) == "cannot open /dev/null at 9600 baud: it is no serial port"


def test_tcp_port_that_refuses_is_named_without_numbers(listener):
    host, port = listener.getsockname()
    listener.close()
    with pytest.raises(TransportError) as refused:
        TcpTransport(host, port)
    assert str(refused.value) == f"cannot connect to {host}:{port}: Connection refused"


def test_serial_url_that_refuses_is_named_once_and_without_numbers(listener):
    url = "socket://{}:{}".format(*listener.getsockname())
    listener.close()
    with pytest.raises(TransportError) as refused:
        SerialTransport(url, 9600)
    assert str(refused.value) == f"cannot open {url} at 9600 baud: Connection refused"


def test_tcp_host_that_no_one_knows_is_reported_so(monkeypatch):
    def unknown(*_, **__):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "create_connection", unknown)
    with pytest.raises(TransportError, match=r"^cannot connect to lidar:2111: Name or service not known$"):
        TcpTransport("lidar", 2111)


def test_serial_unplugged_is_a_transport_error():
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    with SerialTransport(path, 115_200) as port:
        os.close(slave)
        os.close(master)
        with pytest.raises(TransportError, match="unplugged"):
            port.read(5.0)


def test_serial_port_that_takes_nothing_is_given_up(terminal, monkeypatch):
    """A device that hangs: no one reads the other end."""
    monkeypatch.setattr(transport, "WRITE_TIMEOUT_S", 0.1)
    master, path = terminal
    with SerialTransport(path, 115_200) as port:
        with pytest.raises(
            TransportError, match=r"took \d+ of 100000 bytes within 0.1 s; does the device hang"
        ):
            port.write(bytes(100_000))
        os.set_blocking(master, False)
        with suppress(BlockingIOError):
            while os.read(master, 65_536):
                pass
        port.write(b"to")
        assert os.read(master, 10) == b"to"


def test_serial_long_writes_go_through_whole(terminal):
    master, path = terminal
    sent = bytes(range(256)) * 400
    received = bytearray()

    def hear():
        while len(received) < len(sent):
            received.extend(os.read(master, 65_536))

    with SerialTransport(path, 115_200) as port:
        thread = threading.Thread(target=hear, daemon=True)
        thread.start()
        port.write(sent)
        thread.join(5.0)
    assert received == sent


def test_serial_url_that_cannot_be_waited_for_is_refused_with_one_that_can(monkeypatch):
    class Remote:
        closed = False

        def fileno(self):
            raise io.UnsupportedOperation("fileno")

        def close(self):
            self.closed = True

    remote = Remote()
    monkeypatch.setattr(transport.serial, "serial_for_url", lambda *_, **__: remote)
    with pytest.raises(TransportError, match="write socket://host:port"):
        SerialTransport("rfc2217://127.0.0.1:4000", 115_200)
    assert remote.closed


def test_serial_takes_a_socket_url(listener):
    host, address_port = listener.getsockname()
    with SerialTransport(f"socket://{host}:{address_port}", 115_200) as port:
        peer, _ = listener.accept()
        with peer:
            peer.sendall(b"fro")
            assert port.read(5.0) == b"fro"
            port.write(b"to")
            assert peer.recv(10) == b"to"
