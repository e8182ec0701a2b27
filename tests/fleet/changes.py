"""Changes that no gateway may keep: each takes a configuration and the gateway it is for, and spoils it."""


def bus_a(spoil):
    return lambda configuration, gateway: spoil(configuration["bus"][0])


def drive_a1(spoil):
    return lambda configuration, gateway: spoil(configuration["bus"][0]["drive"][0])


def section(of, /, **values):
    return lambda configuration, gateway: configuration.setdefault(of, {}).update(values)


def without(name):
    return lambda configuration, gateway: configuration.pop(name)


def certificate(of, name):
    """One of the test's authority, or one that it did not sign."""
    def spoil(configuration, gateway):
        certificates = gateway.plant.certificates
        configuration[of].update(certificate=certificates.path(f"{name}.crt"), key=certificates.path(f"{name}.key"))

    return spoil


def plain_broker(configuration, gateway):
    url = f"mqtt://localhost:{gateway.plant.broker_plain}"
    (gateway.directory / "wrong-password").write_text("wrong")
    configuration["mqtt"] = {"url": url, "username": "fleet", "password_file": "wrong-password"}


def another(name):
    """An address that another gateway listens on."""
    def spoil(configuration, gateway):
        other = gateway.plant.gateways[(gateway.number + 1) % len(gateway.plant.gateways)]
        listen = f"127.0.0.1:{getattr(other, name)}"
        if name == "http":
            configuration["http"]["listen"] = listen
        else:
            configuration["modbus_tcp"]["listen"] = [listen]

    return spoil


def empty(configuration, gateway):
    configuration.clear()


def line_of_another(configuration, gateway):
    other = gateway.plant.gateways[(gateway.number + 1) % len(gateway.plant.gateways)]
    configuration["bus"][0]["port"] = str(other.directory / "line-a")


def lines_swapped(configuration, gateway):
    a, b = configuration["bus"]
    a["port"], b["port"] = b["port"], a["port"]


def address(value):
    return drive_a1(lambda drive: drive.update(address=value))


# What `drivegate check` finds: nothing is even tried.
INVALID = {
    "unknown key": section("gateway", nmae="x"),
    "unknown section": section("mqqt", url="mqtt://localhost"),
    "empty": empty,
    "no gateway": without("gateway"),
    "name with a capital": section("gateway", name="Plant"),
    "baud as text": bus_a(lambda bus: bus.update(baud="38400")),
    "baud of 100": bus_a(lambda bus: bus.update(baud=100)),
    "format of seven data bits": bus_a(lambda bus: bus.update(format="7E1")),
    "unknown protocol": bus_a(lambda bus: bus.update(protocol="profibus")),
    "protocol without the profile": bus_a(lambda bus: bus.update(protocol="n2")),
    "ASCII on a line of RTU": bus_a(lambda bus: bus.update(protocol="modbus-ascii", format="7N2")),
    "cycle without a unit": bus_a(lambda bus: bus.update(cycle="200")),
    "no port": bus_a(lambda bus: bus.pop("port")),
    "one port twice": lambda configuration, gateway: configuration["bus"][0].update(port=configuration["bus"][1]["port"]),
    "listening to controlled drives": bus_a(lambda bus: bus.update(mode="listen")),
    "one address twice": address(2),
    "address 0": address(0),
    "address 250": address(250),
    "one name twice": drive_a1(lambda drive: drive.update(name="a2")),
    "unknown profile": drive_a1(lambda drive: drive.update(profile="vacon-mx")),
    "limits upside down": drive_a1(lambda drive: drive.update(limits={"speed_reference": [80.0, 20.0]})),
    "lease of a millisecond": drive_a1(lambda drive: drive.update(supervision={"timeout": "1ms"})),
    "no certificate": section("http", certificate="absent.crt"),
    "key of another certificate": lambda configuration, gateway: configuration["http"].update(
        key=gateway.plant.certificates.path("broker.key")),
    "commands without users": section("http", commands=True),
    "no password file": section("mqtt", username="fleet", password_file="absent"),
    "no authority of the broker": section("mqtt", ca="absent.crt"),
    "broker without a scheme": section("mqtt", url="localhost:1883"),
    "address without a port": section("modbus_tcp", listen=["127.0.0.1"]),
    "network that is none": section("modbus_tcp", write=["10.0.0.0/99"]),
    "https certificate expired": certificate("http", "expired"),
    "client certificate expired": certificate("mqtt", "expired"),
}

# What the gateway refuses, or what makes it worse: tried, and taken back.
WORSE = {
    "address in use, http": another("http"),
    "address in use, Modbus TCP": another("modbus"),
    "address of another machine": section("modbus_tcp", listen=["203.0.113.1:1502"]),
    "socket elsewhere": section("gateway", socket="elsewhere"),
    "broker that is not there": section("mqtt", url="mqtts://localhost:9"),
    "broker without a name": section("mqtt", url="mqtts://broker.invalid"),
    "broker of another authority": lambda configuration, gateway: configuration["mqtt"].update(
        ca=gateway.plant.certificates.path("strange.crt")),
    "broker without TLS": lambda configuration, gateway: configuration.update(
        mqtt={"url": f"mqtt://localhost:{gateway.plant.broker_tls}"}),
    "wrong password": plain_broker,
    "no broker any more": without("mqtt"),
    "no Modbus TCP any more": without("modbus_tcp"),
    "no http any more": without("http"),
    "https certificate of nobody": certificate("http", "strange"),
    "baud 9600": bus_a(lambda bus: bus.update(baud=9600)),
    "baud 19200": bus_a(lambda bus: bus.update(baud=19200)),
    "baud 115200": bus_a(lambda bus: bus.update(baud=115200)),
    "port that is not there": bus_a(lambda bus: bus.update(port="/dev/absent")),
    "line of another gateway": line_of_another,
    "lines swapped": lines_swapped,
    "wrong address": address(5),
    "address of nobody": address(247),
    "another family": drive_a1(lambda drive: drive.update(profile="vacon-cx")),
    "access removed": drive_a1(lambda drive: (drive.pop("access"), drive.pop("supervision"))),
    "lease removed": drive_a1(lambda drive: drive.pop("supervision")),
    "drive removed": bus_a(lambda bus: bus["drive"].pop(0)),
    "drive renamed": drive_a1(lambda drive: drive.update(name="pump")),
    "bus removed": lambda configuration, gateway: configuration["bus"].pop(0),
}

# Of these the bus `b` is not untouched.
BOTH_BUSES = {"lines swapped"}
