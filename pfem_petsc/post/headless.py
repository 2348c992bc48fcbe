"""Drawing without a display: finds a working OpenGL library before VTK uses one, because VTK would crash."""

from __future__ import annotations

import functools
import os
import subprocess
import sys

from ..errors import InputError

__all__ = ["require_rendering"]

VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"

# Nothing is shown, so a display is not tried first: it may be closed, or remote over ssh.
_HEADLESS = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")

# Draw a red square if there is a library: a crash, a hang or an empty image all count as "does not work". So
# does a window of another kind than asked for, which VTK takes where the library is missing, with warnings each time.
_PROBE = """
import os
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkWindowToImageFilter
renderer, window, grab = vtkRenderer(), vtkRenderWindow(), vtkWindowToImageFilter()
renderer.SetBackground(1, 0, 0)
window.SetOffScreenRendering(1)
window.SetSize(16, 16)
window.AddRenderer(renderer)
window.Render()
assert os.environ.get("VTK_DEFAULT_OPENGL_WINDOW") in (None, window.GetClassName())
grab.SetInput(window)
grab.Update()
assert grab.GetOutput().GetPointData().GetScalars().GetTuple(100)[0] > 200
print("drawn")
"""


def _works(window: str | None) -> bool:
    environment = dict(os.environ)
    if window is not None:
        environment[VARIABLE] = window
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, text=True, timeout=60, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return probe.returncode == 0 and "drawn" in probe.stdout


@functools.cache
def require_rendering() -> None:
    """Ensure that VTK can draw in this process, with EGL or OSMesa, whichever works.

    The user's choice in ``VTK_DEFAULT_OPENGL_WINDOW`` is tried first, the default of VTK last. Call this before the
    first render window.

    Raises
    ------
    InputError
        If no OpenGL library works; the message states what to install.
    """
    own = [os.environ[VARIABLE]] if VARIABLE in os.environ else []
    for window in [*own, *_HEADLESS, None]:
        if _works(window):
            if window is not None:
                os.environ[VARIABLE] = window
            return
    raise InputError(
        "render: no OpenGL library works here, so nothing can be drawn; install one that needs no display "
        "(Debian, Ubuntu: apt-get install libosmesa6, or libegl1 libgl1-mesa-dri; conda: mesalib)"
    )
