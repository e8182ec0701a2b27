#!/usr/bin/env python3
"""Takes out of an image archive (docker-archive) what differs from build to build: the names of the container in which
buildah built it. Nothing reads them.

    deploy/package/same_image.py ARCHIVE
"""

import hashlib
import io
import json
import sys
import tarfile

RANDOM = ("container", "Hostname")


def main():
    archive = sys.argv[1]
    with tarfile.open(archive) as source:
        (manifest,) = json.load(source.extractfile("manifest.json"))
        settings = json.load(source.extractfile(manifest["Config"]))
        layers = {name: source.extractfile(name).read() for name in manifest["Layers"]}
    for part in (settings, settings.get("config", {}), settings.get("container_config", {})):
        for key in RANDOM:
            part.pop(key, None)
    text = json.dumps(settings, sort_keys=True).encode()
    manifest["Config"] = hashlib.sha256(text).hexdigest() + ".json"
    files = {**layers, manifest["Config"]: text, "manifest.json": json.dumps([manifest], sort_keys=True).encode()}
    with tarfile.open(archive, "w", format=tarfile.USTAR_FORMAT) as target:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(content), 0o644
            target.addfile(entry, io.BytesIO(content))


if __name__ == "__main__":
    main()
