"""VTK as a contestant of ``bench raster``: the same points through vtkPolyDataMapper, off screen."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...shared.camera import Camera

FAR = 1e3


class VtkPoints:
    """One vertex and one RGB colour a point, no lighting, no multisampling; EGL where VTK has it.

    positions : (n, 3) float32.  colour : (n,) uint32 colour words.
    Raises ImportError if VTK is not installed.
    """

    name = "vtk"

    def __init__(self, positions: np.ndarray, colour: np.ndarray, width: int, height: int) -> None:
        import vtk  # pyright: ignore[reportMissingImports]
        from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray  # pyright: ignore[reportMissingImports]

        self._vtk = vtk
        n = len(positions)
        points = vtk.vtkPoints()
        points.SetData(numpy_to_vtk(positions, deep=True))
        cells = vtk.vtkCellArray()  # one poly-vertex
        cells.SetData(
            numpy_to_vtkIdTypeArray(np.array([0, n], np.int64), deep=True),
            numpy_to_vtkIdTypeArray(np.arange(n, dtype=np.int64), deep=True),
        )
        data = vtk.vtkPolyData()
        data.SetPoints(points)
        data.SetVerts(cells)
        rgb = np.ascontiguousarray(colour.view(np.uint8).reshape(-1, 4)[:, :3])
        data.GetPointData().SetScalars(numpy_to_vtk(rgb, deep=True))
        mapper = vtk.vtkPolyDataMapper()
        mapper.SetInputData(data)
        mapper.SetStatic(True)
        actor = vtk.vtkActor()
        actor.SetMapper(mapper)
        actor.GetProperty().LightingOff()
        actor.GetProperty().SetPointSize(1)
        self._renderer = vtk.vtkRenderer()
        self._renderer.SetBackground(0, 0, 0)
        self._renderer.AddActor(actor)
        self._window = vtk.vtkEGLRenderWindow() if hasattr(vtk, "vtkEGLRenderWindow") else vtk.vtkRenderWindow()
        self._window.SetOffScreenRendering(True)
        self._window.SetMultiSamples(0)
        self._window.SetSize(width, height)
        self._window.AddRenderer(self._renderer)
        self._pixels = vtk.vtkUnsignedCharArray()

    @property
    def device(self) -> str:
        """Version of VTK and the renderer that it found; known after the first frame."""
        report = self._window.ReportCapabilities().splitlines()
        renderer = next((line.partition(":")[2].strip() for line in report if "renderer string" in line), "?")
        return f"VTK {self._vtk.VTK_VERSION}, {renderer}"

    def draw(self, camera: Camera, world_from_camera: np.ndarray, fov_y_rad: float) -> np.ndarray:
        """(height, width, 3) uint8, row 0 on top."""
        from vtkmodules.util.numpy_support import vtk_to_numpy  # pyright: ignore[reportMissingImports]

        eye, back, up = (world_from_camera[:3, i] for i in (3, 2, 1))
        view = self._renderer.GetActiveCamera()
        view.SetPosition(*eye)
        view.SetFocalPoint(*(eye - back))
        view.SetViewUp(*up)
        view.SetViewAngle(math.degrees(fov_y_rad))
        view.SetClippingRange(camera.near, FAR * camera.near)
        self._window.Render()
        self._window.GetPixelData(0, 0, camera.width - 1, camera.height - 1, 0, self._pixels, 0)
        return vtk_to_numpy(self._pixels).reshape(camera.height, camera.width, 3)[::-1]

    def close(self) -> None:
        """Release the window and its context."""
        self._window.Finalize()

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
