"""What the soak counts and judges: violations, the orders and their answers, the figures of the process."""

import os
import time

# Codes that say that nothing was sent to the drive (docs/commands.md, Results).
NOT_SENT = {
    "not_allowed", "not_writable", "bad_value", "queue_full", "replaced", "purged", "bus_down", "shutting_down",
    "unknown_drive", "offline", "expired",
}


class Judge:
    """Violations, printed as they are found."""

    def __init__(self):
        self.violations = 0
        self.values = 0
        self.skipped = []

    def violation(self, text):
        self.violations += 1
        if self.violations <= 100:
            print(f"VIOLATION {time.strftime('%H:%M:%S')} {text}", flush=True)

    def skip(self, text):
        self.skipped.append(text)
        print(f"skipped: {text}", flush=True)

    def reading(self, drive, values, window):
        """Values of one drive that the gateway called good."""
        self.values += 1
        wrong = drive.check(values, time.monotonic(), window)
        if wrong:
            self.violation(f"wrong value: {wrong}")


class Orders:
    """Every order is answered exactly once, and the answer is true for drives whose writes are known."""

    def __init__(self, judge):
        self.judge = judge
        self.open = {}  # id -> (time placed, drive or None, reference in counts or None)
        self.answered = {}  # id -> time
        self.later = []  # (time, drive, reference, placed): to be looked at once nothing can be on its way
        self.placed = 0
        self.results = {}
        self.next_reference = 0

    def reference(self):
        """A reference that no order had for thousands of orders, 0 to 9999 counts of 0.01 %."""
        self.next_reference = (self.next_reference + 1) % 9973
        return self.next_reference

    def place(self, order, drive=None, reference=None):
        self.placed += 1
        self.open[order] = (time.monotonic(), drive, reference)

    def withdraw(self, order):
        """The order never reached the gateway."""
        self.open.pop(order, None)

    def answer(self, order, result):
        now = time.monotonic()
        self.results[result] = self.results.get(result, 0) + 1
        if order not in self.open:
            when = "a second time" if order in self.answered else "without having been placed"
            self.judge.violation(f"order {order} answered {when}: {result}")
            return
        placed, drive, reference = self.open.pop(order)
        self.answered[order] = now
        if drive is None or reference is None:
            return
        if result in ("confirmed", "acknowledged"):
            if drive.received.get(reference, 0.0) < placed:
                self.judge.violation(f"order {order} is {result}, but {drive.name} never received {reference}")
        elif result in NOT_SENT:
            self.later.append((now + 3.0, drive, reference, placed, order, result))

    def inspect(self, limit):
        """Violations of orders without an answer for `limit` seconds, and of those said not to have been sent."""
        now = time.monotonic()
        for order, (placed, _, _) in list(self.open.items()):
            if now - placed > limit:
                self.judge.violation(f"order {order} has no answer after {limit} s")
                del self.open[order]
        due = [entry for entry in self.later if entry[0] <= now]
        self.later = [entry for entry in self.later if entry[0] > now]
        for _, drive, reference, placed, order, result in due:
            if drive.received.get(reference, 0.0) >= placed:
                self.judge.violation(f"order {order} is {result}, but {drive.name} received {reference}")
        for order in [order for order, at in self.answered.items() if now - at > 600]:
            del self.answered[order]


class Process:
    """Memory, descriptors, threads and processor time of a process."""

    def __init__(self, pid):
        self.pid = pid
        self.ticks, self.at = self.cpu_ticks(), time.monotonic()

    def status(self):
        with open(f"/proc/{self.pid}/status") as file:
            return dict(line.split(":", 1) for line in file if ":" in line)

    def cpu_ticks(self):
        with open(f"/proc/{self.pid}/stat") as file:
            fields = file.read().rsplit(")", 1)[1].split()
        return int(fields[11]) + int(fields[12])

    def sample(self):
        """RSS in MiB, that which is the process's own (no pages of files), descriptors, threads, percent of a core since the last sample."""
        status = self.status()
        ticks, now = self.cpu_ticks(), time.monotonic()
        cpu = 100.0 * (ticks - self.ticks) / os.sysconf("SC_CLK_TCK") / max(now - self.at, 0.001)
        self.ticks, self.at = ticks, now
        mib = lambda key: int(status[key].split()[0]) / 1024.0
        return (
            mib("VmRSS"),
            mib("RssAnon"),
            len(os.listdir(f"/proc/{self.pid}/fd")),
            int(status["Threads"]),
            cpu,
        )


def slope(points):
    """Least squares through (x, y): y for each x."""
    count = len(points)
    mean_x = sum(x for x, _ in points) / count
    mean_y = sum(y for _, y in points) / count
    over = sum((x - mean_x) ** 2 for x, _ in points)
    return sum((x - mean_x) * (y - mean_y) for x, y in points) / over if over else 0.0
