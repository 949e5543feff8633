# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Wheel and source distribution that are the same at every build, and a bill of materials.

``python -m tools.distribution dist``: both archives, and their hashes. Times in them are those of
``SOURCE_DATE_EPOCH``, by default of the last commit.

``python -m tools.distribution sbom.json``: CycloneDX of the installed packages that pkm_twin needs.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
NAME = "pkm_twin"
CLASSIFIED = {
    "BSD": "BSD-3-Clause",
    "MIT": "MIT",
    "Apache": "Apache-2.0",
    "MPL": "MPL-2.0",
    "Python Software": "PSF-2.0",
    "ISC": "ISC",
    "Historical": "HPND",
}
"""Words of a licence's text or classifier, and its SPDX name."""


def build(target: Path) -> dict[str, str]:
    """Build both archives into a folder; return the SHA-256 by file name."""
    git = subprocess.run(["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True)
    # Without git, the first time that a zip file can have.
    epoch = os.environ.get("SOURCE_DATE_EPOCH") or git.stdout.strip() or "315532800"
    # Archives contain file modes, so fix the mask.
    os.umask(0o022)
    target = target.resolve()
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        code = f"from setuptools import build_meta as b; b.build_sdist({folder!r})"
        _python("-c", code, epoch=epoch)
        (made,) = Path(folder).glob("*.tar.gz")
        source = target / made.name
        source.write_bytes(_normalise_archive(made, int(epoch)))
        with tarfile.open(source) as archive:
            archive.extractall(folder, filter="data")
        (tree,) = (path for path in Path(folder).iterdir() if path.is_dir())
        code = f"from setuptools import build_meta as b; print(b.build_wheel({str(target)!r}))"
        wheel = _python("-c", code, epoch=epoch, cwd=tree).split()[-1]
    files = (source, target / wheel)
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def _python(*words: str, epoch: str, cwd: Path = ROOT) -> str:
    environment = {**os.environ, "SOURCE_DATE_EPOCH": epoch, "PYTHONHASHSEED": "0"}
    done = subprocess.run([sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    return done.stdout


def _normalise_archive(path: Path, epoch: int) -> bytes:
    """Rewrite an archive in order, with one time and without accounts."""
    data = io.BytesIO()
    with tarfile.open(path) as source, tarfile.open(fileobj=data, mode="w") as target:
        for member in sorted(source.getmembers(), key=lambda member: member.name):
            member.mtime, member.uid, member.gid, member.uname, member.gname = epoch, 0, 0, "", ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            member.pax_headers = {}
            target.addfile(member, source.extractfile(member) if member.isfile() else None)
    return gzip.compress(data.getvalue(), mtime=epoch)


def find_dependencies(name: str = NAME) -> dict[str, metadata.Distribution]:
    """Find a package's installed dependencies, and theirs, by normal name, without extras."""
    found: dict[str, metadata.Distribution] = {}
    todo = [name]
    while todo:
        own = metadata.distribution(todo.pop())
        for line in own.requires or ():
            word = re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", line)[0]).lower()
            if "extra ==" not in line and word not in found:
                try:
                    found[word] = metadata.distribution(word)
                except metadata.PackageNotFoundError:
                    continue  # Of another platform or Python.
                todo.append(word)
    return dict(sorted(found.items()))


def licence(package: metadata.Distribution) -> str:
    """Return a package's SPDX expression, or its own short text."""
    about = package.metadata
    if "License-Expression" in about:
        return str(about["License-Expression"])
    classified = [c for c in about.get_all("Classifier", []) if c.startswith("License")]
    text = " ".join([*classified, str(about.get("License", "")).partition("\n")[0]])
    names = {name for word, name in CLASSIFIED.items() if word in text}
    return " AND ".join(sorted(names)) or text.strip()[:60] or "NOASSERTION"


def make_bill_of_materials() -> dict[str, Any]:
    """Write the bill of materials, CycloneDX 1.5."""

    def component(name: str, package: metadata.Distribution) -> dict[str, Any]:
        reference = f"pkg:pypi/{name}@{package.version}"
        return {
            "type": "library",
            "bom-ref": reference,
            "name": name,
            "version": package.version,
            "purl": reference,
            "licenses": [{"expression": licence(package)}],
        }

    packages = find_dependencies()
    own = component("pkm-twin", metadata.distribution(NAME)) | {"licenses": [{"expression": "Apache-2.0"}]}
    parts = [component(name, package) for name, package in packages.items()]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": own},
        "components": parts,
        "dependencies": [{"ref": own["bom-ref"], "dependsOn": [p["bom-ref"] for p in parts]}],
    }


def main() -> None:
    """Build, or list."""
    target = Path(sys.argv[1])
    if target.suffix == ".json":
        made = make_bill_of_materials()
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
        for part in made["components"]:
            print(f"{part['name']} {part['version']}: {part['licenses'][0]['expression']}")
    else:
        for name, digest in build(target).items():
            print(f"{digest}  {name}")


if __name__ == "__main__":
    main()
