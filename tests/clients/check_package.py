"""Checks the Debian package, from its build to its removal.

    built       `.debian/build` makes the package twice, with the same bytes; lintian finds no fault
    installed   the program converts frames, also as the service under the service's account
                man shows the pages without a warning; every link in the documentation has a target
                bash, zsh and fish complete the commands; systemd accepts the unit, which is not enabled
    removed     no file of the package is left

The check restores the machine, also after a failure. It stops if a meniscus is installed already, because it
must not remove that one.
"""

import contextlib
import grp
import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from project import OWN, ROOT, WORK, Check

AS_ROOT = [] if os.geteuid() == 0 else ["sudo", "-n"]
NAME = "meniscus"
PROGRAM = Path("/usr/bin/meniscus")
CONFIG = Path("/etc/meniscus/meniscus.toml")
UNIT = "/usr/lib/systemd/system/meniscus.service"
PAGES = Path("/usr/share/man/man1")
DOCS = Path("/usr/share/doc/meniscus")
# The typed text, and a completion that the shell must offer for it.
TYPED = {"conv": "convert", "convert --vox": "--voxel-size", "convert --preset gra": "granular"}
# Folders where systemd's helpers would record that the unit is enabled.
HELPERS = [Path("/var/lib/systemd/deb-systemd-helper-enabled"), Path("/etc/systemd/system")]
# The only expected warning about a page. Pages have no date, so that the same program makes the same pages.
EXPECTED_OF_PAGES = re.compile(r'WARNING: missing date, using ""')
# Lintian's expected findings, with the reasons.
EXPECTED_BY_LINTIAN = {
    "initial-upload-closes-no-bugs": "the package is not submitted to Debian",
}


def main():
    check = Check("package: made, installed, used and removed")
    there = leftovers()
    if there:
        check.line("machine", "there is a meniscus already", [f"{each} would not survive" for each in there])
        check.end()
    # Exit normally on SIGTERM, so that the package is removed, too.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    package = made(check)
    if package:
        try:
            if installed(check, package):
                used(check)
        finally:
            removed(check)
    check.end()


def made(check):
    """Makes the package. Returns its path, or None after a failure."""
    packages, said = [], ""
    for _ in range(2):
        ran = run(ROOT / ".debian" / "build")
        said = ran.stderr
        if ran.returncode:
            check.line("build", f"exit status {ran.returncode}", said.splitlines()[-5:])
            return None
        path = Path(ran.stdout.strip())
        packages.append(path.read_bytes())
    faults = [] if packages[0] == packages[1] else ["made again, it has other bytes"]
    check.line("build", f"{path.name}, {len(packages[0]) / 1e6:.1f} MB", faults)
    check.line("version", *changelog_is_of_this_version(path))
    check.line("lintian", *lintian(path))
    return path


def changelog_is_of_this_version(package):
    """Whether the package and Debian's changelog have the version in Cargo.toml."""
    version = re.search(r'^version = "(.+)"$', (ROOT / "Cargo.toml").read_text(), re.MULTILINE)[1]
    first = (ROOT / ".debian" / "changelog").read_text().split()[1].strip("()")
    faults = [] if first.rpartition("-")[0] == version else [f"the changelog is of {first}"]
    if not package.name.startswith(f"{NAME}_{first}_"):
        faults.append(f"the package is {package.name}")
    return first, faults


def lintian(package):
    ran = run("lintian", "--fail-on", "none", "--allow-root", package)
    found = [line for line in ran.stdout.splitlines() if line[:2] in ("E:", "W:")]
    faults = [line for line in found if line.split()[2] not in EXPECTED_BY_LINTIAN]
    if ran.returncode:
        faults.append(ran.stderr.strip())
    return f"{len(found)} remarks, {len(found) - len(faults)} of them expected", faults


def installed(check, package):
    """Installs the package; returns whether the program then exists."""
    # Minimal images of Debian exclude manuals and documentation from installation: include them.
    include = ["--path-include=/usr/share/man/*", "--path-include=/usr/share/doc/*"]
    ran = run(*AS_ROOT, "dpkg", *include, "--install", package)
    faults = ran.stderr.splitlines()[-5:] if ran.returncode else []
    missing = [path for path in [PROGRAM, CONFIG, UNIT] if not Path(path).is_file()]
    faults += [f"no {path}" for path in missing]
    conffiles = run("dpkg-query", "--show", "--showformat=${Conffiles}", NAME).stdout.split()
    if str(CONFIG) not in conffiles:
        faults.append(f"{CONFIG} is not a configuration file")
    links = [path for folder in HELPERS for path in folder.rglob("meniscus*") if path.is_symlink()]
    faults += [f"the unit is enabled: {link}" for link in links]
    check.line("install", f"{len(run('dpkg', '--listfiles', NAME).stdout.splitlines())} files and folders", faults)
    return not missing


def used(check):
    with tempfile.TemporaryDirectory(prefix="meniscus-package-") as folder:
        folder = Path(folder)
        check.line("convert", *converts(folder / "converted"))
        check.line("service", *serves(folder))
    check.line("man", *pages_are_clean())
    check.line("docs", *links_lead_somewhere())
    for shell, ask in {"bash": ask_bash, "zsh": ask_zsh, "fish": ask_fish}.items():
        check.line(shell, *completes(ask))
    check.line("unit", *unit_is_sound())


def converts(out):
    ran = run(PROGRAM, "convert", OWN, "--out", out)
    written = sorted(path.name for path in out.glob("*.glb"))
    wanted = sorted(f"{path.stem}.glb" for path in OWN.iterdir() if path.suffix == ".bgeo")
    faults = [ran.stderr.strip()] if ran.returncode else []
    if written != wanted or not wanted:
        faults.append(f"there are {written}")
    return f"{len(written)} of {len(wanted)} frames", faults


def links_lead_somewhere():
    """Checks the links in the installed documentation."""
    faults, count = [], 0
    for page in DOCS.rglob("*.md"):
        code_aside = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)\s]+)", code_aside):
            if "://" not in target and not target.startswith("#"):
                count += 1
                if not (page.parent / target.partition("#")[0]).exists():
                    faults.append(f"{page.relative_to(DOCS)}: {target} is not there")
    if count < 50:
        faults.append("there are hardly any links")
    return f"{count} links", faults


def serves(folder):
    """Runs the program with the installed configuration, except the folders, under the account of the
    service."""
    folder.chmod(0o755)
    surfaces = folder / "surfaces"
    surfaces.mkdir()
    run(*AS_ROOT, "chown", NAME, surfaces)
    frames = folder / "frames"
    shutil.copytree(OWN, frames)
    config = CONFIG.read_text()
    mine = config.replace("/srv/frames", str(frames)).replace("/srv/surfaces", str(surfaces))
    (folder / "meniscus.toml").write_text(mine)
    daemon = [PROGRAM, "watch", "--config", folder / "meniscus.toml", "--once"]
    ran = run(*AS_ROOT, "runuser", "-u", NAME, "--", *daemon)
    count = len(list(surfaces.glob("*.glb")))
    faults = [] if ran.returncode == 0 else [f"exit status {ran.returncode}", *ran.stderr.splitlines()[-3:]]
    if count == 0 or mine == config:
        faults.append("no frame was converted")
    return f"{count} frames", faults


def pages_are_clean():
    """Checks that neither groff nor mandoc prints a warning about a page, and that every command has a
    page."""
    pages = sorted(PAGES.glob("meniscus*.1.gz"))
    faults = []
    for page in pages:
        show = ["man", "--warnings", "--encoding=UTF-8", "--local-file", page]
        groff = run(*show, env={**os.environ, "MANWIDTH": "100"})
        mandoc = run("mandoc", "-T", "lint", "-W", "warning", page)
        said = (groff.stderr + mandoc.stdout + mandoc.stderr).splitlines()
        faults += [line for line in said if not EXPECTED_OF_PAGES.search(line)]
        if groff.returncode:
            faults.append(f"{page.name} cannot be shown")
    commands = commands_of_the_help()
    faults += [f"no page for {name}" for name in commands if not (PAGES / f"meniscus-{name}.1.gz").is_file()]
    return f"{len(pages)} pages", faults


def commands_of_the_help():
    listed = run(PROGRAM, "--help").stdout.split("Commands:\n")[1].split("\n\n")[0]
    # Lines that continue a description are indented farther.
    entries = [line for line in listed.splitlines() if re.match("  [a-z]", line)]
    return [line.split()[0] for line in entries if line.split()[0] != "help"]


def completes(ask):
    """Checks the completions that a shell offers for the Tab key."""
    faults = []
    for words, wanted in TYPED.items():
        typed = words.split()
        ran = ask(typed)
        if wanted not in ran.stdout.split():
            faults.append(f"{words}: {wanted} is not among {ran.stdout.split()[:5]} {ran.stderr.strip()}")
    return "commands, options, values", faults


def ask_bash(typed):
    script = """
        . /usr/share/bash-completion/completions/meniscus
        function=$(complete -p meniscus | sed 's/.*-F \\([^ ]*\\).*/\\1/')
        COMP_WORDS=(meniscus "$@") COMP_CWORD=$#
        $function meniscus "${COMP_WORDS[$COMP_CWORD]}" "${COMP_WORDS[$COMP_CWORD - 1]}"
        printf '%s\\n' "${COMPREPLY[@]}"
    """
    return run("bash", "--norc", "-c", script, "bash", *typed)


def ask_fish(typed):
    """Asks fish for completions. It writes into the home folder of its user, so it gets a temporary one."""
    with tempfile.TemporaryDirectory(prefix="meniscus-package-") as home:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")}
        ask = f"cd {home}; complete --do-complete 'meniscus {' '.join(typed)}'"
        return run("fish", "-c", ask, env={**environment, "HOME": home})


def ask_zsh(typed):
    """Asks zsh for completions. It completes only in a terminal: it gets one, and a tab as soon as it reads
    keys."""
    setup = """
        PS1= PS2=; autoload -Uz compinit; compinit -u -D
        begun() { print BEG''UN }; zle -N zle-line-init begun
        show() { zle -I; print -r -- "<$BUFFER>" }; zle -N show; bindkey '^G' show
    """
    script = r"""
        zmodload zsh/zpty
        zpty shell zsh -f -i
        zpty -w shell "$1"
        zpty -r shell said '*BEGUN*'
        zpty -w -n shell "meniscus $2"$'\t\x07'
        zpty -r shell said '*<meniscus *>*'
        print -r -- ${${${said##*<}%%>*}//=/ }
    """
    setup = setup.strip().replace("\n", ";")
    return run("timeout", "60", "zsh", "-f", "-c", script, "zsh", setup, " ".join(typed))


def unit_is_sound():
    ran = run("systemd-analyze", "verify", UNIT)
    said = [line for line in (ran.stdout + ran.stderr).splitlines() if NAME in line]
    return "systemd-analyze verify", said or ([ran.stderr.strip()] if ran.returncode else [])


def removed(check):
    """Purges the package, including its configuration, also if it is only partly installed."""
    ran = run(*AS_ROOT, "dpkg", "--purge", NAME)
    faults = ran.stderr.splitlines()[-5:] if ran.returncode else []
    check.line("remove", "nothing is left", faults + [f"{each} is left" for each in leftovers()])


def leftovers():
    """Files and accounts of the package that are left on this machine."""
    places = [PROGRAM, CONFIG.parent, Path(UNIT), Path("/usr/share/doc/meniscus"), *PAGES.glob("meniscus*")]
    places += [path for folder in HELPERS for path in folder.rglob("meniscus*")]
    places += [path for path in Path("/usr/share").glob("*/*completion*/*meniscus*")]
    found = [str(path) for path in places if os.path.lexists(path)]
    state = run("dpkg-query", "--show", "--showformat=${db:Status-Status}", NAME).stdout
    if state and state != "not-installed":
        found.append(f"the package, {state},")
    for database in [pwd.getpwnam, grp.getgrnam]:
        with contextlib.suppress(KeyError):
            found.append(f"the entry {database(NAME)[0]} in {database.__name__}")
    return found


def run(*words, env=None):
    """Runs a program until it ends, and captures its output."""
    command = [str(word) for word in words]
    return subprocess.run(command, capture_output=True, text=True, env=env, stdin=subprocess.DEVNULL, timeout=1800)


main()
