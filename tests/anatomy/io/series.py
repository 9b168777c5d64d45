"""A CT as a DICOM series."""

from __future__ import annotations

from pathlib import Path

from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

from anatomy.grid import Volume


def write_series(folder: Path, volume: Volume, number: int = 1, **changes: object) -> str:
    """Write stored = HU + 1024, slices in shuffled order of file names; return the series UID."""
    folder.mkdir(exist_ok=True)
    uid, matrix, spacing = generate_uid(), volume.grid.lps_from_ijk, volume.grid.spacing_mm
    direction = matrix[:3, :3] / spacing
    for k in range(volume.grid.shape[2]):
        slice_ = Dataset()
        slice_.file_meta = FileMetaDataset()
        slice_.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        slice_.file_meta.MediaStorageSOPClassUID = slice_.SOPClassUID = CTImageStorage
        slice_.file_meta.MediaStorageSOPInstanceUID = slice_.SOPInstanceUID = generate_uid()
        slice_.SeriesInstanceUID, slice_.SeriesNumber, slice_.SeriesDescription = uid, number, "Lung 1.0"
        slice_.Modality = "CT"
        slice_.Columns, slice_.Rows = volume.grid.shape[:2]
        slice_.PixelSpacing = [float(spacing[1]), float(spacing[0])]
        slice_.SliceThickness = float(spacing[2])
        slice_.ImageOrientationPatient = [*direction[:, 0].tolist(), *direction[:, 1].tolist()]
        slice_.ImagePositionPatient = volume.grid.lps([0, 0, k]).tolist()
        slice_.SamplesPerPixel, slice_.PhotometricInterpretation = 1, "MONOCHROME2"
        slice_.BitsAllocated, slice_.BitsStored, slice_.HighBit, slice_.PixelRepresentation = 16, 16, 15, 0
        slice_.RescaleSlope, slice_.RescaleIntercept = 1, -1024
        for key, value in changes.items():
            setattr(slice_, key, value)
        slice_.PixelData = (volume.array[:, :, k].T + 1024).astype("<u2").tobytes()
        slice_.save_as(folder / f"{number}-{(k * 5) % volume.grid.shape[2]}.dcm", enforce_file_format=True)
    return uid
