"""Stays connected with TLS: tls_client.py PORT CA CERTIFICATE KEY. Prints `answered` after one request, `ended` when the
gateway closes the connection, `refused` if it never answers."""

import socket
import ssl
import sys

port, ca, certificate, key = int(sys.argv[1]), *sys.argv[2:]
context = ssl.create_default_context(cafile=ca)
context.load_cert_chain(certificate, key)
try:
    stream = context.wrap_socket(socket.create_connection(("127.0.0.1", port)), server_hostname="127.0.0.1")
    stream.sendall(bytes.fromhex("000100000005ff2b0e0400"))
    answer = stream.recv(300)
except OSError as error:
    sys.exit(f"refused: {error}")
if not answer:
    sys.exit("refused: closed")
print("answered", flush=True)
try:
    while stream.recv(300):
        pass
    print("ended", flush=True)
except OSError as error:
    print(f"broken: {error}", flush=True)
