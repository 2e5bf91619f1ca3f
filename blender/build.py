"""Makes the Blender extension: `meniscus-<version>.zip`, which Blender installs from disk.

    blender/build.py [--out FOLDER] WHEEL...

A folder means all wheels in it. Each wheel is that of pymeniscus for one platform; the extension then works on these
platforms. Blender contains numpy, which is the only other package that pymeniscus needs.
"""

import argparse
import re
import sys
import zipfile
from pathlib import Path

SOURCE = Path(__file__).resolve().parent / "meniscus"
# The tags of wheels, and Blender's names of these platforms.
PLATFORMS = (
    (r"manylinux.*_x86_64|linux_x86_64", "linux-x64"),
    (r"manylinux.*_aarch64|linux_aarch64", "linux-arm64"),
    (r"macosx_.*_x86_64", "macos-x64"),
    (r"macosx_.*_arm64", "macos-arm64"),
    (r"win_amd64", "windows-x64"),
    (r"win_arm64", "windows-arm64"),
)


def platform_of(wheel: Path) -> str:
    """Blender's name of the platform of a wheel.

    Raises
    ------
    ValueError
        If the file is not a wheel of pymeniscus for a platform of Blender.
    """
    found = re.fullmatch(r"pymeniscus-[^-]+-cp3\d+-abi3-([^-]+)\.whl", wheel.name)
    if not found:
        raise ValueError(f"{wheel}: the name is not that of an abi3 wheel of pymeniscus")
    for tag, name in PLATFORMS:
        if re.fullmatch(tag, found[1].split(".")[0]):
            return name
    raise ValueError(f"{wheel}: Blender has no platform {found[1]}")


def wheels_of(path: Path) -> list[Path]:
    """The wheels in a folder, or the file itself.

    Raises
    ------
    ValueError
        If the folder has no wheel.
    """
    if not path.is_dir():
        return [path]
    if not (wheels := sorted(path.glob("*.whl"))):
        raise ValueError(f"{path}: the folder has no wheel")
    return wheels


def build(wheels: list[Path], out: Path) -> Path:
    """Writes the extension into a folder, and returns its path. The same inputs give the same bytes."""
    platforms = [platform_of(wheel) for wheel in wheels]
    if len(set(platforms)) != len(platforms):
        raise ValueError(f"two wheels are for the same platform: {', '.join(platforms)}")
    manifest = (SOURCE / "blender_manifest.toml").read_text(encoding="utf-8")
    version = re.search(r'^version = "([^"]+)"$', manifest, re.MULTILINE)[1]
    lists = f"platforms = {listed(platforms)}\nwheels = {listed(f'./wheels/{wheel.name}' for wheel in wheels)}\n"
    # Keys of the top level come before the first table.
    manifest = manifest.replace("[permissions]", f"{lists}\n[permissions]", 1)
    members = {"blender_manifest.toml": manifest.encode()}
    for path in sorted(SOURCE.rglob("*.py")):
        members[path.relative_to(SOURCE).as_posix()] = path.read_bytes()
    members["LICENSE"] = (SOURCE.parents[1] / "LICENSE-MIT").read_bytes()
    for wheel in wheels:
        members[f"wheels/{wheel.name}"] = wheel.read_bytes()
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"meniscus-{version}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            entry = zipfile.ZipInfo(name)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, data)
    return path


def listed(words) -> str:
    return "[" + ", ".join(f'"{word}"' for word in words) + "]"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("wheels", nargs="+", type=Path, metavar="WHEEL", help="wheel of pymeniscus, or a folder of wheels")
    parser.add_argument("--out", type=Path, default=Path(), help="folder for the extension [default: .]")
    options = parser.parse_args()
    try:
        print(build([wheel for path in options.wheels for wheel in wheels_of(path)], options.out))
    except (OSError, ValueError) as error:
        sys.exit(f"build.py: {error}")


if __name__ == "__main__":
    main()
