"""pyserial's RFC 2217 server in front of a serial port: rfc2217_server.py DEVICE PORT.

Serves one connection after the other; prints `listening`, and after each connection the settings that its client made.
A pseudo-terminal keeps eight data bits without parity, so the settings are those that pyserial was given.
"""

import select
import socket
import sys

import serial
import serial.rfc2217


class Connection:
    """What the port manager writes to."""

    def __init__(self, sock):
        self.sock = sock

    def write(self, data):
        self.sock.sendall(data)


class Port(serial.Serial):
    """A pseudo-terminal, which has neither formats nor control lines: the settings are kept as they were given."""

    def _reconfigure_port(self, force_update=False):
        if force_update:
            super()._reconfigure_port(force_update)

    def _update_dtr_state(self):
        print("DTR", "on" if self._dtr_state else "off", flush=True)

    def _update_rts_state(self):
        print("RTS", "on" if self._rts_state else "off", flush=True)

    cts = dsr = ri = cd = False


def serve(sock, device):
    port = Port(device, 9600, timeout=0)
    manager = serial.rfc2217.PortManager(port, Connection(sock))
    try:
        while True:
            ready, _, _ = select.select([sock, port], [], [])
            if sock in ready:
                data = sock.recv(1024)
                if not data:
                    break
                port.write(b"".join(manager.filter(data)))
            if port in ready:
                sock.sendall(b"".join(manager.escape(port.read(1024))))
    except OSError:
        pass
    print(f"{port.baudrate} {port.bytesize}{port.parity}{port.stopbits}", flush=True)
    port.close()


listener = socket.create_server(("127.0.0.1", int(sys.argv[2])))
print("listening", listener.getsockname()[1], flush=True)
while True:
    client, _ = listener.accept()
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    serve(client, sys.argv[1])
    client.close()
