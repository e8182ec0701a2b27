"""A broker that keeps what it acknowledged, and can be cut off at any moment: just enough of MQTT v5 for one gateway."""

import json
import socket
import threading


class CountingBroker:
    """Accepts one gateway; records its events in their order. One in fifty it records, and loses the acknowledgement."""

    def __init__(self, dice):
        self.dice = dice
        self.events = []
        self.sessions = 0
        self.lock = threading.Lock()
        self.listener = None
        self.stream = None
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]

    def start(self):
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", self.port))
        listener.listen()
        self.listener = listener
        threading.Thread(target=self.accept, args=(listener,), daemon=True).start()

    def cut(self):
        """As a kill: nothing more is read, acknowledged or accepted."""
        with self.lock:
            for end in (self.listener, self.stream):
                if end is not None:
                    try:
                        end.shutdown(socket.SHUT_RDWR)
                    except OSError:
                        pass
                    end.close()
            self.listener = self.stream = None

    def accept(self, listener):
        while True:
            try:
                stream, _ = listener.accept()
            except OSError:
                return
            self.stream = stream
            self.sessions += 1
            threading.Thread(target=self.serve, args=(stream,), daemon=True).start()

    def serve(self, stream):
        try:
            source = stream.makefile("rb")
            while head := source.read(1):
                length, shift = 0, 0
                while True:
                    byte = source.read(1)[0]
                    length |= (byte & 0x7F) << shift
                    shift += 7
                    if byte < 0x80:
                        break
                self.packet(stream, head[0], source.read(length))
        except (OSError, IndexError, ValueError):
            pass
        finally:
            stream.close()

    def packet(self, stream, head, body):
        kind = head >> 4
        if kind == 1:
            stream.sendall(bytes([0x20, 3, 0, 0, 0]))
        elif kind == 8:
            filters, rest = 0, body[3:]
            while len(rest) > 2:
                rest = rest[int.from_bytes(rest[:2], "big") + 3 :]
                filters += 1
            stream.sendall(bytes([0x90, 3 + filters]) + body[:2] + bytes([0]) + bytes([1] * filters))
        elif kind == 12:
            stream.sendall(bytes([0xD0, 0]))
        elif kind == 3:
            self.publish(stream, head, body)

    def publish(self, stream, head, body):
        length = int.from_bytes(body[:2], "big")
        topic, rest = body[2 : 2 + length].decode(), body[2 + length :]
        if not head & 0x06:
            return
        packet, rest = rest[:2], rest[2:]
        payload = rest[1 + rest[0] :]
        with self.lock:
            # Cut off in the meantime: neither kept nor acknowledged.
            if self.stream is not stream:
                return
            if topic.endswith("/event"):
                event = json.loads(payload)
                self.events.append((event["boot"], event["id"], topic))
                if self.dice.random() < 0.02:
                    stream.shutdown(socket.SHUT_RDWR)
                    return
            stream.sendall(bytes([0x40, 2]) + packet)
