"""Datasets with their images in the tables, as LeRobot stores the feature type ``image``."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.data.convert import convert
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.inspection import validate
from fluxvla_core.data.sampler import SampleKey
from fluxvla_core.data.video_decode import image_size
from fluxvla_core.errors import DataError

from .version2 import write_v2

TOP, WRIST = "observation.images.top", "observation.images.wrist"


def load(root, cameras=("top", "wrist"), **options):
    return ParquetDataset(str(root), [], list(cameras), **options)


def edit(path, change):
    """Replace the wrist's column of a table."""
    table = pq.read_table(path)
    place = table.schema.get_field_index(WRIST)
    pq.write_table(table.set_column(place, WRIST, change(table[WRIST].to_pylist())), path)


@pytest.fixture
def old(tmp_path, takes):
    return write_v2(tmp_path / "old", takes, codec="png")


@pytest.fixture
def new(tmp_path, old):
    return convert(old, tmp_path / "new")


@pytest.mark.parametrize("cache", [False, True])
@pytest.mark.parametrize("which", ["old", "new"])
def test_images_are_those_that_were_stored(which, cache, takes, request):
    dataset = load(request.getfixturevalue(which), cache_frames=cache)
    keys = [SampleKey(0, i) for i in np.random.default_rng(0).permutation(28)]
    found = {key.index: s for key, s in zip(keys, dataset.get_samples(keys), strict=True)}
    row = 0
    for take in takes:
        for top, wrist in zip(take.top, take.wrist, strict=True):
            for image, expected in zip(found[row]["images"], (top, wrist), strict=True):
                np.testing.assert_array_equal(image.transpose(1, 2, 0), expected)
            row += 1


def test_a_part_of_the_episodes(old, takes):
    dataset = load(old, episodes=[2])
    np.testing.assert_array_equal(dataset[3]["images"][0].transpose(1, 2, 0), takes[2].top[3])


def test_jpegs_and_shapes_with_the_channels_first(tmp_path, takes):
    root = write_v2(tmp_path / "jpg", takes, codec="jpg")
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"][TOP].update(shape=[3, 32, 48], names=["channels", "height", "width"])
    path.write_text(json.dumps(info))
    image = load(root, cache_frames=True)[9]["images"][0]
    assert image.shape == (3, 32, 48)
    assert np.abs(image.transpose(1, 2, 0).astype(int) - takes[1].top[2]).mean() < 8
    assert validate(root)[0].startswith("meta/fluxvla_embodiment.json is missing")


def test_video_and_stored_images_in_one_dataset(tmp_path, takes):
    root = write_v2(tmp_path / "both", takes)
    stored = write_v2(tmp_path / "stored", takes, codec="png")
    for path in stored.glob("data/*/*.parquet"):
        (root / path.relative_to(stored)).write_bytes(path.read_bytes())
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"][WRIST].update(dtype="image", info=None)
    path.write_text(json.dumps(info))
    for dataset in (load(root), load(convert(root, tmp_path / "new"))):
        top, wrist = (image.transpose(1, 2, 0) for image in dataset[8]["images"])
        np.testing.assert_array_equal(wrist, takes[1].wrist[1])
        assert np.abs(top.astype(int) - takes[1].top[1]).mean() < 8


def test_commands_know_them(old, tmp_path, capsys):
    assert main(["data", "inspect", str(old)]) == 0
    assert f"  camera    {TOP}: 32 x 48, in the tables\n" in capsys.readouterr().out
    out = str(tmp_path / "new")
    assert main(["data", "convert", str(old), out]) == 0
    assert main(["data", "validate", out]) == 0
    capsys.readouterr()
    assert main(["data", "stats", out, "--pixels", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found[TOP] == json.loads((tmp_path / "new/meta/stats.json").read_text())[TOP]


def test_images_that_are_damaged_are_named(old):
    path = old / "data/chunk-000/episode_000001.parquet"
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    edit(path, lambda rows: pa.array([*rows[:6], {"bytes": b"?", "path": "x"}, *rows[7:]], kind))
    where = rf"{path}: {WRIST}: the image of row 6 cannot be decoded"
    with pytest.raises(DataError, match=where):
        load(old)[13]
    with pytest.raises(DataError, match=where):
        validate(old)
    nameless = {"bytes": None, "path": "images/6.png"}
    edit(path, lambda rows: pa.array([*rows[:6], nameless, *rows[7:]], kind))
    with pytest.raises(DataError, match="row 6 holds no image, at most the name of one"):
        load(old)[13]


def test_a_column_of_something_else_is_refused_before_training(old):
    edit(old / "data/chunk-000/episode_000001.parquet", lambda rows: pa.array(range(len(rows))))
    with pytest.raises(DataError, match="wrist holds int64, not the bytes of images"):
        load(old)
    assert len(load(old, ["top"])) == 28


def test_an_image_is_looked_at_before_it_is_decoded(old):
    """20,000 x 20,000 equal pixels are 1 MB as a PNG and 1.2 GB in memory."""
    path = next(iter(sorted(old.glob("data/*/*.parquet"))))
    whole = bytearray(pq.read_table(path)[TOP][0].as_py()["bytes"])
    whole[16:24] = (20_000).to_bytes(4, "big") * 2
    table = pq.read_table(path)
    rows = table[TOP].to_pylist()
    rows[0]["bytes"] = bytes(whole)
    place = table.schema.get_field_index(TOP)
    pq.write_table(table.set_column(place, TOP, pa.array(rows, table[TOP].type)), path)
    with pytest.raises(DataError, match=r"row 0 is 20000 x 20000, info\.json says 32 x 48"):
        load(old)[0]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("size", [(1, 1), (480, 640), (33, 7)])
def test_the_size_in_an_images_header(suffix, size):
    data = cv2.imencode(suffix, np.zeros((*size, 3), np.uint8))[1].tobytes()
    assert image_size(data) == size
    assert image_size(data[:10]) is None
    assert image_size(b"BM" + data) is None
