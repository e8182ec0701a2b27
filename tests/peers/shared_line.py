"""A two-wire line on pseudo-terminals: shared_line.py DRIVES MASTER LISTENER

DRIVES is the port of simulated drives. At MASTER another master reaches them; at LISTENER everything is heard that master and
drives say. Prints `ready`, and at its end `the listener sent N bytes`."""

import os
import select
import signal
import sys
import tty


def pseudo_terminal(link):
    """A raw pseudo-terminal; its own end, and the other one kept open so that programs may come and go."""
    own, other = os.openpty()
    tty.setraw(own)
    tty.setraw(other)
    if os.path.islink(link):
        os.unlink(link)
    os.symlink(os.ttyname(other), link)
    os.set_blocking(own, False)
    return own, other


def give(port, data):
    """A port that nobody reads takes what it has room for."""
    try:
        os.write(port, data)
    except BlockingIOError:
        pass


def main():
    drives = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(drives)
    master, keep_master = pseudo_terminal(sys.argv[2])
    listener, keep_listener = pseudo_terminal(sys.argv[3])
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    sent = 0
    print("ready", flush=True)
    try:
        while True:
            for port in select.select([drives, master, listener], [], [])[0]:
                data = os.read(port, 4096)
                if port == listener:
                    sent += len(data)
                elif port == master:
                    give(drives, data)
                    give(listener, data)
                else:
                    give(listener, data)
                    give(master, data)
    finally:
        print(f"the listener sent {sent} bytes", flush=True)


main()
