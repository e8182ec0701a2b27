"""Holds discovery messages, one in a line of JSON with `topic` and `payload`, against the schemas of Home Assistant: run by the
Python that has it. Prints one line for each fault."""

import asyncio
import importlib
import json
import sys
import tempfile

import probatio
from homeassistant.components.mqtt import discovery
from homeassistant.components.sensor.const import DEVICE_CLASS_STATE_CLASSES
from homeassistant.core import HomeAssistant
from homeassistant.helpers import frame


def faults(payload):
    discovery._replace_all_abbreviations(payload)
    try:
        discovery.DEVICE_DISCOVERY_SCHEMA(payload)
    except probatio.Invalid as fault:
        yield "the device", fault
        return
    for key, config in payload["components"].items():
        config = dict(config)
        platform = config.pop("platform")
        if not config:
            continue  # taken away
        discovery._merge_common_device_options(config, payload)
        config["device"] = payload["device"]
        config["origin"] = payload["origin"]
        try:
            valid = importlib.import_module(f"homeassistant.components.mqtt.{platform}").DISCOVERY_SCHEMA(config)
        except probatio.Invalid as fault:
            yield key, fault
            continue
        possible = DEVICE_CLASS_STATE_CLASSES.get(valid.get("device_class"))
        state = valid.get("state_class")
        if platform == "sensor" and state and possible is not None and state not in possible:
            yield key, f"{state} is no state class of {valid['device_class']}"


async def main():
    # Templates are parsed by an instance, which is never started.
    with tempfile.TemporaryDirectory() as directory:
        frame.async_setup(HomeAssistant(directory))
        count = 0
        for line in sys.stdin:
            message = json.loads(line)
            payload = json.loads(message["payload"])
            count += len(payload["cmps"])
            for key, fault in faults(payload):
                print(f"{message['topic']}: {key}: {fault}")
        print(f"{count} entities")


asyncio.run(main())
