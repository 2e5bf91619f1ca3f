"""Tests of particles from files."""

from __future__ import annotations

import json

import numpy as np
import pytest

import pymeniscus as pm


def test_every_example_is_read():
    from conftest import FRAMES

    for path in FRAMES.iterdir():
        if path.is_file():
            particles = pm.read(path)
            assert particles.positions.shape[1] == 3 and len(particles) == len(particles.positions) > 10, path
            assert all(len(values) == len(particles) for values in particles.values())
            assert repr(particles) and particles.path == str(path)


def test_types_and_roles_are_those_of_the_file(tmp_path):
    points = np.arange(12, dtype=np.float64).reshape(4, 3)
    path = tmp_path / "frame.npz"
    np.savez(path, position=points, velocity=points.astype(np.float32), id=np.arange(4), density=np.ones(4))
    particles = pm.read(path)
    assert particles.positions.dtype == np.float64 and np.array_equal(particles.positions, points)
    assert particles["velocity"].dtype == np.float32 and particles.roles["velocity"] == "velocity"
    assert particles["id"].dtype.kind == "i" and particles.roles["id"] == "id"
    assert set(particles) == {"velocity", "id", "density"} and len(particles) == 4
    particles["velocity"][:] = 0
    with pytest.raises(KeyError, match="no attribute `mass`; the attributes are: `velocity`, `id`, `density`"):
        particles["mass"]


@pytest.mark.parametrize(("name", "others"), [("v", ["velocity", "vel"]), ("rho", ["density"])])
def test_attributes_are_found_by_other_names_of_their_role(tmp_path, name, others):
    arrays = {"v": np.ones((4, 3)), "rho": np.arange(4.0)}
    path = tmp_path / "frame.npz"
    for stored, *asked in [(name, *others), *((other, name) for other in others)]:
        np.savez(path, position=np.zeros((4, 3)), **{stored: arrays[name]})
        particles = pm.read(path)
        assert list(particles) == [stored]
        assert all(other in particles and particles[other] is particles[stored] for other in asked), stored
        assert "mass" not in particles and particles.get("mass") is None and particles.get(name) is particles[stored]


def test_names_of_other_quantities_find_nothing(tmp_path):
    path = tmp_path / "frame.npz"
    np.savez(path, position=np.zeros((4, 3)), phase=np.arange(4), radius=np.ones(4))
    particles = pm.read(path)
    assert particles["kind"] is particles["phase"] and particles["pscale"] is particles["radius"]
    for name in ("object", "diameter"):
        with pytest.raises(KeyError, match="the attributes are: `phase`, `radius`"):
            particles[name]


ROWS, IDS = "0 0 0 1 2 3 4 5 6", "7 8 9"
VTK = f"# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 3 double\n{ROWS}\n"
XDMF = "<DataItem Dimensions='{}' Precision='8' NumberType='{}' Format='XML'>{}</DataItem>".format
TEXTS = {
    "a.json": json.dumps({"positions": [[0, 0, 0], [1, 2, 3], [4, 5, 6]], "id": [7, 8, 9]}),
    "a.vtk": f"{VTK}POINT_DATA 3\nSCALARS id int\nLOOKUP_TABLE default\n{IDS}\n",
    "b.pvd": "<VTKFile type='Collection'><Collection><DataSet timestep='0.5' file='a.vtk'/></Collection></VTKFile>",
    "c.vtk.series": json.dumps({"file-series-version": "1.0", "files": [{"name": "a.vtk", "time": 0.5}]}),
    "d.xmf": f"<Xdmf><Domain><Grid><Geometry GeometryType='XYZ'>{XDMF('3 3', 'Float', ROWS)}</Geometry>"
    f"<Attribute Name='id' Center='Node'>{XDMF('3', 'Int', IDS)}</Attribute></Grid></Domain></Xdmf>",
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_that_solvers_write_is_read(tmp_path, name):
    for each, text in TEXTS.items():
        (tmp_path / each).write_text(text)
    particles = pm.read(tmp_path / name)
    assert np.array_equal(particles.positions, [[0, 0, 0], [1, 2, 3], [4, 5, 6]]), particles.positions
    assert particles["id"].tolist() == [7, 8, 9] and particles.roles["id"] == "id"


@pytest.mark.parametrize(
    ("name", "count", "roles"),
    [
        ("prt/version_1_0.prt", 3, "id velocity"),
        ("hdf5/records.h5", 6, "id velocity"),
        ("hdf5/steps.h5part/step=2", 6, "id velocity"),
        ("usd/points.usda", 20, "id kind radius velocity"),
        ("usd/points.usdc", 20, "id kind radius velocity"),
        ("usd/points.usdz", 20, "id kind radius velocity"),
        ("abc/points.abc/step=1", 3, "radius"),
        ("vdb_points/null_none.vdb", 4, "color id kind normal velocity"),
    ],
)
def test_binary_files_of_solvers_are_read(name, count, roles):
    from conftest import ROOT

    particles = pm.read(ROOT / "tests" / "fuzz" / "corpus" / name)
    assert len(particles) == count and np.isfinite(particles.positions).all()
    assert sorted(set(particles.roles.values())) == roles.split()


def test_text_columns_are_read(tmp_path):
    path = tmp_path / "frame.csv"
    path.write_text("x,y,z,phase\n0,0,0,water\n1,0,0,oil\n0,1,0,water\n")
    particles = pm.read(path)
    assert particles["phase"].tolist() == ["water", "oil", "water"]


def test_errors_of_files(tmp_path):
    with pytest.raises(FileNotFoundError):
        pm.read(tmp_path / "none.ply")
    (tmp_path / "cut.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n")
    with pytest.raises(pm.FormatError, match="cut.ply"):
        pm.read(tmp_path / "cut.ply")
    (tmp_path / "text.docx").write_bytes(b"PK\x03\x04 and more")
    with pytest.raises(pm.FormatError):
        pm.read(tmp_path / "text.docx")


def test_attributes_of_particles_are_selected_by_name(frame, tmp_path):
    points = np.random.default_rng(0).random((500, 3)).astype(np.float32)
    path = tmp_path / "frame.npz"
    np.savez(path, position=points, velocity=points, age=points[:, 0])
    particles = pm.read(path)
    named = pm.reconstruct(particles, preset="noisy", attributes=["age"])
    assert set(named.attributes) == {"age"}
    assert set(pm.reconstruct(particles, preset="noisy", attributes="all").attributes) == {"velocity", "age"}
    assert not pm.reconstruct(particles, preset="noisy").attributes
    with pytest.warns(UserWarning, match="heat"):
        pm.reconstruct(particles, preset="noisy", attributes=["age", "heat"])


def test_columns_of_a_table_get_names(tmp_path):
    path = tmp_path / "parcels.csv"
    path.write_text("n,alpha,beta,gamma\n7,1,2,3\n8,4,5,6\n", encoding="utf-8")
    with pytest.raises(pm.FormatError, match="name the columns, as in"):
        pm.read(path)
    particles = pm.read(path, columns="x=alpha,y=3,z=gamma,id=n")
    same = pm.read(path, columns={"x": "alpha", "y": 3, "z": "gamma", "id": "n"})
    assert (same.positions == particles.positions).all()
    assert particles.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert particles["id"].tolist() == [7, 8]
    with pytest.raises(ValueError, match="columns: `x` does not name columns"):
        pm.read(path, columns="x")
