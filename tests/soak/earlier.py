"""The events of an earlier run."""

import itertools
import json
import time

COUNT = 6000  # more than the gateway keeps
# As the load of the soak makes them: whether they come from each drive, each bus or the gateway, and their text.
KINDS = {
    "online": ("drive", "drive {drive} answers"),
    "offline": (
        "drive",
        "drive {drive} is offline: it does not reply; check its power, wiring and address (`drivegate diagnose line1`); retrying at least "
        "every 10 s",
    ),
    "started": ("drive", "drive {drive} has started: commanded by mqtt drivegate/soak/drive/{drive}/set"),
    "stopped": ("drive", "drive {drive} has stopped: commanded by mqtt drivegate/soak/drive/{drive}/set"),
    "fault": ("drive", "drive {drive} has fault 14: drive overtemperature"),
    "fault_end": ("drive", "the fault of drive {drive} has cleared"),
    "not_confirmed": (
        "drive",
        "drive {drive} acknowledged run=true speed_reference=24.53 but did not show it within 2s: the motor does not run; blocked by "
        "undervoltage (undervoltage_stop_active is on)",
    ),
    "recording": (
        "drive",
        "recording 20260203T082147.555Z-{drive}: 10 transactions on the line failed within 10 s, 4 of them with this drive; 1.6 s "
        "before: 1 timeout, 2 corrupt replies; speed 0 %, current 0 A, DC 560 V",
    ),
    "refused_command": (
        "drive",
        "refused write holding 33024 = 0x0001 from modbus_tcp 127.0.0.2:42239: this client may not write: its address is not in "
        '`write`, or, with TLS, its certificate has no role that `roles` maps to "control" (19 commands of it were refused)',
    ),
    "bus_up": ("bus", "port lines/{bus} of bus {bus} is open"),
    "bus_down": (
        "bus",
        "bus {bus} is down: cannot open lines/{bus}: No such file or directory; check that the adapter is plugged in and the path is "
        "right; retrying at least every 3 s",
    ),
    "diagnosis": (
        "bus",
        "{bus}: requests arrive truncated (likely): 6 replies came after the timeout of 150 ms in the last minute; "
        "check the cable and its terminals, and the supply of the drives",
    ),
    "reload_refused": (
        "gateway",
        "the configuration was not applied, the previous one stays: unknown key `fil`; gateway.toml:119, audit.fil; did you mean `file`?",
    ),
}


def write_events(path, drives):
    """As many as the gateway keeps, of all kinds and drives (names with the bus of each), since it keeps as many of each that comes
    often enough. Until its list is full and even, which takes most of a day, it grows, and would pass for a leak."""
    buses = sorted({bus for _, bus in drives})
    places = {"drive": drives, "bus": [(None, bus) for bus in buses], "gateway": [(None, None)]}
    kinds = [(kind, text, *place) for kind, (of, text) in KINDS.items() for place in places[of]]
    begin = time.time() - 86400
    with open(path, "w", encoding="utf-8") as file:
        for number, (kind, text, drive, bus) in zip(range(COUNT), itertools.cycle(kinds)):
            at = time.strftime("%Y-%m-%dT%H:%M:%S.000Z", time.gmtime(begin + number))
            text = text.format(drive=drive, bus=bus)
            event = {"id": number + 1, "boot": "00000000000050ac", "time": at, "event": kind, "bus": bus, "drive": drive}
            if kind in ("started", "stopped"):
                event["by"] = f"mqtt drivegate/soak/drive/{drive}/set"
            if kind == "recording":
                event["recording"] = {"id": text.split()[1][:-1], "trigger": "line", "summary": text.split(": ", 1)[1]}
            event["text"] = text
            file.write(json.dumps({key: value for key, value in event.items() if value is not None}) + "\n")
