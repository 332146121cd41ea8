"""Light of the flats and what else is recorded: lamps, sky, shades, particles, few frames."""

import numpy as np

from second_bench.sensors.model import F64, Drawn, Sensor, Series, kind, middle, places


@kind()
def stack(sensor: Sensor) -> Drawn:
    """A hundred flats for which the lamp was brighter than for the ladder."""
    off = float(sensor.rng.uniform(0.02, 0.06))
    of = middle(sensor)
    sensor.series.append(Series("flat", 100, of.exptime_s, of.light_e * (1 + off)))
    return {"off": off}


@kind()
def fading_lamp(sensor: Sensor) -> Drawn:
    """A lamp that warms up along the ladder and repeats its levels badly; delayed exposures."""
    rng, flats = sensor.rng, [one for one in sensor.series if one.kind == "flat"]
    drift, scatter = float(rng.uniform(-0.05, 0.05)), float(rng.uniform(0.001, 0.005))
    late = float(rng.uniform(0, 0.05)) * min(one.exptime_s for one in flats)
    for n, one in enumerate(flats):
        lamp = 1 + drift * n / len(flats) + scatter * rng.standard_normal()
        one.light_e *= lamp * (1 + late / one.exptime_s)
    return {"drift": drift, "scatter": scatter, "late_s": late}


@kind()
def vignetted(sensor: Sensor) -> Drawn:
    """Dark corners, dust, pixels with dark current of a long tail, exposure times with jitter."""
    rng, (y, x) = sensor.rng, places(sensor.shape)
    shade = np.exp(-rng.uniform(0.5, 3) * (x**2 + y**2))
    for _ in range(6):
        at, size = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.01, 0.04)
        ring = np.hypot(y - at[0], x - at[1]) / size
        shade *= 1 - rng.uniform(0.02, 0.15) * np.exp(-(ring**4))
    sensor.response = sensor.response * shade
    tail = rng.pareto(1.5, sensor.shape) * np.median(sensor.dark_e_s)
    sensor.dark_e_s = sensor.dark_e_s + np.minimum(tail, 20 * sensor.read_noise_e.mean())
    # The tail is continuous: the limit above which a pixel is hot depends on the program.
    off = np.abs(sensor.dark_e_s - np.median(sensor.dark_e_s))
    sensor.unclear = off > 4 * 1.4826 * np.median(off)
    return {"corner": float(shade.min())}


@kind()
def few(sensor: Sensor) -> None:
    """Two bias frames, no darks, pairs of flats at three levels."""
    flats = [one for one in sensor.series if one.kind == "flat"]
    chosen = [flats[0], flats[len(flats) // 2], flats[-1]]
    sensor.series = [Series("bias", 2, 0.0, 0.0), *chosen]


@kind()
def without_bias(sensor: Sensor) -> None:
    """Darks at two exposure times, no bias frames."""
    sensor.series = [one for one in sensor.series if one.kind != "bias"]


@kind("?")
def twilight(sensor: Sensor) -> Drawn:
    """Flats of the sky: the light fades, and its gradient turns from frame to frame."""
    rng, (y, x) = sensor.rng, places(sensor.shape)
    fade, slope = float(rng.uniform(0.02, 0.15)), float(rng.uniform(0.003, 0.03))
    turn = float(rng.uniform(0.05, 0.5))

    def sky(lit: F64, number: int) -> F64:
        gradient = slope * (x * np.cos(turn * number) + y * np.sin(turn * number))
        return np.asarray(lit * (1 + gradient) * (1 + fade * rng.uniform(-0.5, 0.5)))

    sensor.lighting.append(sky)
    return {"fade": fade, "slope": slope, "turn": turn}


@kind()
def round_field(sensor: Sensor) -> Drawn:
    """A round field is lit; the corners are dark."""
    rng, (ny, nx) = sensor.rng, sensor.shape
    y, x = np.mgrid[:ny, :nx]
    radius, soft = float(rng.uniform(0.42, 0.55) * nx), float(rng.uniform(1, 12))
    inside = 1 / (1 + np.exp((np.hypot(y - ny / 2, x - nx / 2) - radius) / soft))
    sensor.response = sensor.response * inside
    sensor.unclear = inside < 0.2
    return {"radius_px": radius, "soft_px": soft}


@kind()
def strong_vignetting(sensor: Sensor) -> Drawn:
    """Corners get a tenth to a third of the light."""
    y, x = places(sensor.shape)
    corner = float(sensor.rng.uniform(0.1, 0.33))
    sensor.response = sensor.response * corner ** (2 * (x**2 + y**2))
    return {"corner": corner}


@kind("?")
def moving_dust(sensor: Sensor) -> Drawn:
    """Grains of dust that move at some frame."""
    rng, (ny, nx) = sensor.rng, sensor.shape
    y, x = np.mgrid[:ny, :nx]
    flats = sum(one.frames for one in sensor.series if one.kind == "flat")
    last = sum(one.frames for one in sensor.series)
    moves = last - int(rng.uniform(0.3, 0.7) * flats)
    shades = np.ones((2, ny, nx))
    for _ in range(8):
        at, by = rng.uniform(0, 1, 2) * (ny, nx), rng.uniform(-6, 6, 2)
        size, depth = rng.uniform(3, 12), rng.uniform(0.01, 0.08)
        for shade, (row, column) in zip(shades, (at, at + by), strict=True):
            shade *= 1 - depth * np.exp(-((np.hypot(y - row, x - column) / size) ** 4))
    sensor.lighting.append(lambda lit, number: lit * shades[int(number > moves)])
    sensor.unclear = np.abs(np.diff(shades, axis=0)[0]) > 0.002
    return {"from_frame": moves}


@kind("?")
def warming_darks(sensor: Sensor) -> Drawn:
    """The dark current rises while the darks are taken."""
    rise = float(sensor.rng.uniform(0.05, 0.4))
    first = sensor.series[0].frames
    darks = sum(one.frames for one in sensor.series if one.kind == "dark")
    times = [one.exptime_s for one in sensor.series for _ in range(one.frames)]

    def warmer(e: F64, number: int) -> F64:
        since = min(max(number - first, 0) / darks, 1.0)
        return e + sensor.rng.poisson(rise * since * sensor.dark_e_s * times[number - 1])

    sensor.collected.append(warmer)
    return {"rise": rise}


@kind("cosmic_hits")
def particles(sensor: Sensor) -> Drawn:
    """Tracks of particles in all frames, also during readout."""
    rng, (ny, nx) = sensor.rng, sensor.shape
    often = float(np.exp(rng.uniform(np.log(1), np.log(10))))
    per_px = float(rng.uniform(20, 60) * sensor.read_noise_e.mean())

    def hit(e: F64, _: int) -> F64:
        out = e.copy()
        for _ in range(rng.poisson(often)):
            at, angle = rng.uniform(0, 1, 2) * (ny, nx), rng.uniform(0, 2 * np.pi)
            length, charge = rng.exponential(4) + 0.5, per_px * rng.lognormal(0, 0.4)
            along = np.arange(0, length, 0.1)
            y = np.rint(at[0] + along * np.sin(angle) + 0.2 * rng.standard_normal(len(along)))
            x = np.rint(at[1] + along * np.cos(angle) + 0.2 * rng.standard_normal(len(along)))
            inside = (y >= 0) & (y < ny) & (x >= 0) & (x < nx)
            np.add.at(out, (y[inside].astype(int), x[inside].astype(int)), 0.1 * charge)
        return out

    sensor.collected.append(hit)
    return {"a_frame": often, "e_px": per_px}
