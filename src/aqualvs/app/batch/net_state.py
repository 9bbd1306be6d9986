"""The state of a dive's net, told from its finished run and kept until something changes."""

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aqualvs.app.batch.dataset import holds_net, put_net
from aqualvs.app.batch.ledger import read_seal, scratch, seal, sealed
from aqualvs.app.batch.work import DiveWork, content_digest, digest
from aqualvs.app.disk import writing
from aqualvs.app.net import StoredDive
from aqualvs.app.net_request import NetRequest
from aqualvs.app.outputs import NET_FILES
from aqualvs.app.report import write_report
from aqualvs.app.stored_scans import stored_scans
from aqualvs.errors import AqualvsError

NET = "net"
"""Folder, below a dive's home, with the seal of its net's state."""


def with_net(work: DiveWork, key: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return a finished dive's facts with the state of its net, which is told now if it is wanted.

    Parameters
    ----------
    work : DiveWork
    key : str
        Of the dive's result, `Survey.key`.
    facts : mapping
        From `join_dive`.

    Returns
    -------
    facts : dict
        With `net`, as `net_facts` has it, where it is known, or with `net_fault`, which says why
        not. The dive's own result stands in any case.
    """
    request = work.request.net
    if request is None:
        return dict(facts) | known_net(work.home, key)
    try:
        return dict(facts) | {"net": _state(work, f"{key}-{_digest(request)}", request)}
    except AqualvsError as fault:
        return dict(facts) | {"net_fault": str(fault)}


def known_net(home: Path, key: str) -> dict[str, Any]:
    """Return what was told of a dive's net, as `with_net` does it; empty if nothing was.

    Parameters
    ----------
    home : Path
        Of the dive.
    key : str
        Of its result; what was told of another does not count.
    """
    found = read_seal(home / NET)
    if found is None or not str(found["key"]).startswith(f"{key}-"):
        return {}
    return {"net": found["facts"]}


def _state(work: DiveWork, key: str, request: NetRequest) -> dict[str, Any]:
    """Return the summary of a net's state: the one that is there, or a new one."""
    out, home = work.request.out, work.home / NET
    found = sealed(home, key, out)
    if found is not None and holds_net(work.dataset, work.name):
        return found
    dive = StoredDive(out)
    net = dive.net_pass(request)
    for scan in stored_scans(out):
        net.add(scan)
    with writing(out), scratch(work.home, NET) as draft:
        result = net.write(draft, dive.video)
        for name in NET_FILES:
            os.replace(draft / name, out / name)
        put_net(work.dataset, work.name, out)
        if work.request.report:
            write_report(out)
        home.mkdir(parents=True, exist_ok=True)
        seal(home, key, result.summary, NET_FILES, out)
    return result.summary


def _digest(request: NetRequest) -> str:
    """Return a short text of all that a net's state depends on besides the dive's result."""
    return digest(asdict(request) | {"log": content_digest(request.log)})
