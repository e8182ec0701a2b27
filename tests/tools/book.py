#!/usr/bin/env python3
"""Builds the pages as a site in target/book by mdbook, and checks every link of the result.

Pages link to files outside of docs, such as ../deploy/compose.yaml: these are copied into the site.
"""
import os
import pathlib
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

ROOT = pathlib.Path(__file__).resolve().parents[2]
STAGE, SITE = ROOT / "target/book-source", ROOT / "target/book"
MORE = {"CONTRIBUTING.md": "Contributing", "SECURITY.md": "Security", "CHANGELOG.md": "Changelog"}
LINK = re.compile(r"(\]\()([^)#\s]+)")


def place(target):
    """Where a file of the repository is in the site's source."""
    path = target.relative_to(ROOT)
    if path.parts[0] == "docs":
        return STAGE.joinpath(*path.parts[1:])
    if str(path) in MORE:
        return STAGE / path
    staged = STAGE / "files" / path
    if not staged.exists():
        staged.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(target, staged)
    return staged


def stage(page):
    here = place(page)

    def moved(link):
        if "://" in link[2]:
            return link[0]
        target = (page.parent / link[2]).resolve()
        return link[1] + os.path.relpath(place(target), here.parent)

    here.parent.mkdir(parents=True, exist_ok=True)
    here.write_text(LINK.sub(moved, page.read_text()))


class Page(HTMLParser):
    def __init__(self, path):
        super().__init__()
        self.links, self.places = [], set()
        self.feed(path.read_text())

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.places.update(filter(None, [attributes.get("id"), attributes.get("name")]))
        self.links.extend(filter(None, [attributes.get("href"), attributes.get("src")]))


def broken():
    pages = {path: Page(path) for path in SITE.rglob("*.html")}
    for path, page in pages.items():
        # The page of errors has absolute links, print.html those of all pages.
        if path.name in ("404.html", "print.html", "toc.html"):
            continue
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or link.startswith("//"):
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                yield f"{path.relative_to(SITE)}: {link}"
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                yield f"{path.relative_to(SITE)}: {link}"


def main():
    for folder in (STAGE, SITE):
        shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "docs", STAGE)
    for page in [*(ROOT / "docs").rglob("*.md"), *(ROOT / name for name in MORE)]:
        stage(page)
    with (STAGE / "SUMMARY.md").open("a") as contents:
        contents.writelines(f"- [{title}]({name})\n" for name, title in MORE.items())
    subprocess.run(["mdbook", "build", str(STAGE), "--dest-dir", str(SITE)], check=True)
    found = list(broken())
    print("\n".join(found), file=sys.stderr)
    return f"{len(found)} broken links" if found else None


if __name__ == "__main__":
    sys.exit(main())
