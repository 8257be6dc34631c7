"""Archives that would unpack to more than memory holds are refused before they are."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.io import unpacked
from caphy.io.measurements import read_measurement
from caphy.io.poses import read_poses


@pytest.mark.parametrize("read", [read_poses, read_measurement, Garment.load])
def test_a_few_kilobytes_of_gigabytes_are_refused(read, tmp_path, monkeypatch):
    monkeypatch.setattr(unpacked, "MAX_BYTES", 2**20)
    np.savez_compressed(tmp_path / "a.npz", poses=np.zeros((2, 165)), more=np.zeros(2**18))
    assert (tmp_path / "a.npz").stat().st_size < 2**13
    with pytest.raises(CaphyError, match=r"a\.npz: would unpack to 0\.0 GiB, must be at most"):
        read(tmp_path / "a.npz")


def test_arrays_of_a_measurement_s_folder_too(tmp_path, monkeypatch):
    monkeypatch.setattr(unpacked, "MAX_BYTES", 2**20)
    (tmp_path / "measurement.toml").write_text('fps = 30\narrays = "a.npz"\n')
    np.savez_compressed(tmp_path / "a.npz", noise=np.zeros(2**18))
    with pytest.raises(CaphyError, match="would unpack"):
        read_measurement(tmp_path)
