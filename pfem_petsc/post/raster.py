"""Draws bars and polygons into an image, without a graphics library.

A bar is a capsule: a cylinder between the projections of its nodes, with half a sphere at each end. A pixel at the
fraction t along the projected axis and the distance s (of the radius) beside it sees the point of the surface with the
normal ``s c + sqrt(1 - s^2) f``, where c is the unit vector across the axis in the picture and f the one across the
axis that faces the eye; it is nearer to the eye than the axis by ``sqrt(1 - s^2)`` times the radius over the sine of
the angle between axis and line of sight. What is linear in the picture is the depth without perspective, and the
reciprocal of the distance with it; this is the ``near`` of nodes and pixels, larger where nearer.

The image has colours multiplied by their opacity (premultiplied alpha), so that it can be laid over any background.
"""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import kernel

__all__ = ["blend_triangles", "draw_bars", "resolve"]

AMBIENT, DIFFUSE, GLOSS = 0.42, 0.66, 0.22
THIN = 1.6  # half widths [pixels] up to which a bar has one shade and no round ends
STEEPEST = 0.25  # sine of the angle to the line of sight below which the depth of the surface is that of this angle


@kernel
def draw_bars(image, depth, x, y, near, size, bars, hidden, radius, least, colours, by_node, light, lift):
    """Draw bars where they are nearer than what is there.

    Parameters
    ----------
    image : (height, width, 4) uint8, changed
    depth : (height, width) float32, ``near`` of what is drawn, changed
    x, y, near : (n,) float64, projected nodes [pixels], and how near they are
    size : (n,) pixels per metre at the nodes; zero or less behind the eye
    bars : (b, 2) int
    hidden : (b,) bool, or (0,) for none
    radius : (b,) [m]
    least : least radius [pixels]
    colours : (n, 3) or (b, 3) uint8
    by_node : whether colours are those of nodes
    light : (3,) unit vector to the light in the picture: right, up, to the eye; zeros: no shades
    lift : (2,) how much ``near`` grows over one pixel towards the eye: ``lift[0] + lift[1]*near``
    """
    height, width = depth.shape
    shaded = light[0] != 0.0 or light[1] != 0.0 or light[2] != 0.0
    for k in range(len(bars)):
        if len(hidden) and hidden[k]:
            continue
        i, j = bars[k, 0], bars[k, 1]
        if size[i] <= 0.0 or size[j] <= 0.0:
            continue
        ra, rb = max(radius[k] * size[i], least), max(radius[k] * size[j], least)
        rim = max(ra, rb)
        x0, y0, x1, y1 = x[i], y[i], x[j], y[j]
        left, right = min(x0, x1) - rim, max(x0, x1) + rim
        top, bottom = min(y0, y1) - rim, max(y0, y1) + rim
        if not (right > 0.0 and left < width and bottom > 0.0 and top < height):
            continue
        dx, dy = x1 - x0, y1 - y0
        length = (dx * dx + dy * dy) ** 0.5
        thin = rim <= THIN
        # depth along the axis in pixels, for the angle to the line of sight
        oa, ob = lift[0] + lift[1] * near[i], lift[0] + lift[1] * near[j]
        mean = 0.5 * (oa + ob)
        dz = (near[j] - near[i]) / mean if mean != 0.0 else 0.0
        whole = (length * length + dz * dz) ** 0.5
        sine = max(length / whole, STEEPEST) if whole > 0.0 else 1.0
        oa, ob, steep = oa * ra, ob * rb, 1.0 / sine
        if length > 1e-6:
            ux, uy = dx / length, dy / length
        else:
            ux, uy = 1.0, 0.0
        # across in the picture is (-uy, ux), downwards; facing is the eye's direction less its part along the axis
        lit_across = light[0] * -uy - light[1] * ux
        cosine = (1.0 - sine * sine) ** 0.5 * (1.0 if dz >= 0.0 else -1.0)
        lit_facing = sine * light[2] - cosine * (light[0] * ux - light[1] * uy)
        flat = 1.0
        if shaded:
            flat = AMBIENT + DIFFUSE * (0.785 * max(0.0, lit_facing) + 0.2 * abs(lit_across))
        along_x = abs(dx) >= abs(dy)
        if along_x:
            first, last, limit = left, right, width
        else:
            first, last, limit = top, bottom, height
        if thin:
            first, last = first + rim, last - rim
        begin, end = max(0, int(np.ceil(first - 0.5))), min(limit - 1, int(np.floor(last - 0.5)))
        other = height if along_x else width
        slant = abs(ux) if along_x else abs(uy)
        inverse = 1.0 / length if length > 1e-6 else 0.0
        for major in range(begin, end + 1):
            # where the axis is in this column (or row), and how far the bar reaches to both sides
            if along_x:
                place = (major + 0.5 - x0) / dx if abs(dx) > 1e-6 else 0.0
                middle = y0 + min(1.0, max(0.0, place)) * dy
            else:
                place = (major + 0.5 - y0) / dy if abs(dy) > 1e-6 else 0.0
                middle = x0 + min(1.0, max(0.0, place)) * dx
            reach = rim / slant
            lower, upper = int(np.ceil(middle - reach - 0.5)), int(np.floor(middle + reach - 0.5))
            if upper < lower:  # thinner than a pixel: the one it is in
                lower = upper = int(np.floor(middle))
            for minor in range(max(0, lower), min(other - 1, upper) + 1):
                column, row = (major, minor) if along_x else (minor, major)
                px, py = column + 0.5 - x0, row + 0.5 - y0
                t = (px * ux + py * uy) * inverse
                t = min(1.0, max(0.0, t))
                if thin:
                    out = near[i] + t * (near[j] - near[i]) + oa + t * (ob - oa)
                    if out <= depth[row, column]:
                        continue
                    share, shine = flat, 0.0
                else:
                    r = ra + t * (rb - ra)
                    ex, ey = px - t * dx, py - t * dy
                    beside = (ex * ex + ey * ey) / (r * r)
                    if beside > 1.0:
                        continue
                    front = (1.0 - beside) ** 0.5
                    body = 0.0 < t < 1.0
                    rise = (oa + t * (ob - oa)) * front
                    out = near[i] + t * (near[j] - near[i]) + (rise * steep if body else rise)
                    if out <= depth[row, column]:
                        continue
                    share, shine = 1.0, 0.0
                    if shaded:
                        if body:
                            lit = (py * ux - px * uy) / r * lit_across + front * lit_facing
                        else:
                            lit = (ex * light[0] - ey * light[1]) / r + front * light[2]
                        lit = max(0.0, lit)
                        share = AMBIENT + DIFFUSE * lit
                        square = lit * lit * lit * lit
                        shine = 255.0 * GLOSS * square * square * square * square
                depth[row, column] = out
                for c in range(3):
                    if by_node:
                        value = colours[i, c] + t * (float(colours[j, c]) - float(colours[i, c]))
                    else:
                        value = float(colours[k, c])
                    image[row, column, c] = np.uint8(min(255.0, value * share + shine))
                image[row, column, 3] = 255


@kernel
def blend_triangles(image, depth, x, y, near, size, triangles, colours):
    """Lay triangles over what is farther away, in their order; they hide nothing that is drawn later.

    Parameters
    ----------
    image, depth, x, y, near, size : as for :func:`draw_bars`
    triangles : (f, 3) int
    colours : (n, 4) uint8, with the opacity, not premultiplied
    """
    height, width = depth.shape
    for k in range(len(triangles)):
        a, b, c = triangles[k, 0], triangles[k, 1], triangles[k, 2]
        if size[a] <= 0.0 or size[b] <= 0.0 or size[c] <= 0.0:
            continue
        whole = (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])
        if abs(whole) < 1e-9:
            continue
        top = max(0, int(np.ceil(min(y[a], y[b], y[c]) - 0.5)))
        bottom = min(height - 1, int(np.ceil(max(y[a], y[b], y[c]) - 0.5)) - 1)
        for row in range(top, bottom + 1):
            # the columns between the two sides that this row crosses; a centre on a shared side belongs to one triangle
            level = row + 0.5
            left, right = np.inf, -np.inf
            for p, q in ((a, b), (b, c), (c, a)):
                if (y[p] <= level) != (y[q] <= level):
                    # from the upper end, so that both triangles of a side compute the same place
                    u, v = (p, q) if y[p] <= y[q] else (q, p)
                    place = x[u] + (level - y[u]) * (x[v] - x[u]) / (y[v] - y[u])
                    left, right = min(left, place), max(right, place)
            if right < left:
                continue
            begin = max(0, int(np.ceil(left - 0.5))) if left > -1.0 else 0
            end = min(width - 1, int(np.ceil(right - 0.5)) - 1) if right < width + 1.0 else width - 1
            for column in range(begin, end + 1):
                px, py = column + 0.5, row + 0.5
                u = ((px - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (py - y[a])) / whole
                v = ((x[b] - x[a]) * (py - y[a]) - (px - x[a]) * (y[b] - y[a])) / whole
                w = 1.0 - u - v
                if w * near[a] + u * near[b] + v * near[c] <= depth[row, column]:
                    continue
                opacity = (w * colours[a, 3] + u * colours[b, 3] + v * colours[c, 3]) / 255.0
                opacity = min(1.0, max(0.0, opacity))
                for channel in range(3):
                    value = w * colours[a, channel] + u * colours[b, channel] + v * colours[c, channel]
                    below = image[row, column, channel] * (1.0 - opacity)
                    image[row, column, channel] = np.uint8(min(255.0, max(0.0, value * opacity + below + 0.5)))
                alpha = 255.0 * opacity + image[row, column, 3] * (1.0 - opacity)
                image[row, column, 3] = np.uint8(min(255.0, alpha + 0.5))


@kernel
def resolve(image, factor, transparent, out):
    """Average squares of pixels, for smooth edges.

    Parameters
    ----------
    image : (factor height, factor width, 4) uint8, premultiplied
    factor : side of the squares in pixels
    transparent : whether colours are divided by their opacity again; else they are laid over white
    out : (height, width, 4) uint8, changed
    """
    count = factor * factor
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            r, g, b, a = 0, 0, 0, 0
            for p in range(factor * row, factor * row + factor):
                for q in range(factor * column, factor * column + factor):
                    r += image[p, q, 0]
                    g += image[p, q, 1]
                    b += image[p, q, 2]
                    a += image[p, q, 3]
            if not transparent:
                white = 255 * count - a
                half = count // 2
                out[row, column, 0] = min(255, (r + white + half) // count)
                out[row, column, 1] = min(255, (g + white + half) // count)
                out[row, column, 2] = min(255, (b + white + half) // count)
                out[row, column, 3] = 255
            elif a > 0:
                out[row, column, 0] = min(255, 255 * r // a)
                out[row, column, 1] = min(255, 255 * g // a)
                out[row, column, 2] = min(255, 255 * b // a)
                out[row, column, 3] = a // count
            else:
                out[row, column] = 0
