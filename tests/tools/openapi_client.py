"""A client that is generated from the description of the API reads each answer: openapi_client.py URL SOCKET NAMES DIRECTORY.

URL is where nobody may command, SOCKET the same gateway where everybody may. NAMES is JSON: what stands for `name` and `id` behind drives, buses, recordings, drills. Prints JSON: the status and the type of
each answer, and of refusals.
"""

import importlib
import inspect
import json
import pathlib
import pkgutil
import subprocess
import sys

import httpx

URL, SOCKET, NAMES, DIRECTORY = sys.argv[1], sys.argv[2], json.loads(sys.argv[3]), pathlib.Path(sys.argv[4])
# Streams have no end, and the page and its files are no objects.
WITHOUT_END = ["get_api_v1_trace", "get_api_v1_events"]


def generated():
    """The package of the client; a warning of the generator is an error."""
    generator = pathlib.Path(sys.executable).with_name("openapi-python-client")
    made = subprocess.run(
        [generator, "generate", "--url", f"{URL}/api/v1/openapi.json", "--output-path", DIRECTORY / "generated",
         "--meta", "none", "--fail-on-warning", "--config", "/dev/stdin"],
        input="post_hooks: []", capture_output=True, text=True, check=False,
    )
    if made.returncode != 0:
        sys.exit(made.stdout + made.stderr)
    sys.path.insert(0, str(DIRECTORY))
    return importlib.import_module("generated")


def described(answer):
    return [int(answer.status_code), type(answer.parsed).__name__]


def main():
    package = generated()
    client = package.Client(base_url=URL, raise_on_unexpected_status=True)
    api = importlib.import_module("generated.api.default")
    answers = {}
    for module in pkgutil.iter_modules(api.__path__):
        kind, _, rest = module.name.partition("_api_v1_")
        if kind != "get" or not rest or module.name in WITHOUT_END:
            continue
        operation = importlib.import_module(f"generated.api.default.{module.name}")
        wanted = [name for name in inspect.signature(operation.sync_detailed).parameters if name in ("name", "id")]
        arguments = {name: NAMES.get(rest.split("_")[0], "none") for name in wanted}
        answers[module.name] = described(operation.sync_detailed(client=client, **arguments))
    command = importlib.import_module("generated.api.default.post_api_v1_drives_name_commands").sync_detailed
    pump = NAMES["drives"]
    local = package.Client(base_url="http://localhost", raise_on_unexpected_status=True)
    local.set_httpx_client(httpx.Client(base_url="http://localhost", transport=httpx.HTTPTransport(uds=SOCKET)))
    orders = [("nobody", {"run": True}), (pump, {"nonsense": 1}), (pump, {"speed_reference": 1e9}), (pump, {"run": False})]
    commands = [described(command(client=local, name=name, body=body)) for name, body in orders]
    commands.append(described(command(client=client, name=pump, body={"run": True})))
    print(json.dumps({"answers": answers, "commands": commands}))


main()
