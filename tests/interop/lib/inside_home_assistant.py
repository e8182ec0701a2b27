"""The real Home Assistant with one integration, commanded by JSON lines: run by the Python that has it.

Without its default integrations (frontend, backup and so on), which play no part and take long to install."""

import asyncio
import json
import logging
import sys

from homeassistant import bootstrap, runner
from homeassistant.helpers import device_registry, entity_registry

# Where its configuration is; the integration; what a user enters to set up one that is not in the configuration, as JSON.
directory, integration, entered = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
complaints = []


class Complaints(logging.Handler):
    """What the integration logs as a warning or worse."""

    def emit(self, record):
        if record.name.startswith("homeassistant") and (integration in record.name or "template" in record.name):
            complaints.append(f"{record.levelname} {record.name}: {record.getMessage()}")


async def answer(hass, command):
    match command["do"]:
        case "entities":
            registry = entity_registry.async_get(hass)
            names = {entry.entity_id: entry.unique_id for entry in registry.entities.values() if entry.platform == integration}
            states = {name: hass.states.get(name) for name in names}
            return {name: {"unique_id": names[name], "state": s and s.state, "attributes": dict(s.attributes) if s else {}}
                    for name, s in states.items()}
        case "devices":
            devices = device_registry.async_get(hass).devices
            return [{"name": d.name, "id": d.id, "via": d.via_device_id, "model": d.model} for d in devices]
        case "call":
            await hass.services.async_call(command["domain"], command["service"], command["data"], blocking=True)
            return None
        case "complaints":
            return complaints


async def main():
    bootstrap.DEFAULT_INTEGRATIONS = set()
    bootstrap.CRITICAL_INTEGRATIONS = set()
    logging.getLogger().addHandler(handler := Complaints(logging.WARNING))
    hass = await bootstrap.async_setup_hass(runner.RuntimeConfig(config_dir=directory))
    await hass.async_start()
    if entered:
        flow = await hass.config_entries.flow.async_init(integration, context={"source": "user"})
        result = await hass.config_entries.flow.async_configure(flow["flow_id"], entered)
        assert result["type"] == "create_entry", result
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    print(json.dumps("ready"), flush=True)
    while line := await reader.readline():
        print(json.dumps(await answer(hass, json.loads(line)), default=str), flush=True)
    logging.getLogger().removeHandler(handler)
    await hass.async_stop()


asyncio.run(main())
