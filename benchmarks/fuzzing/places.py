"""Globs that lead out of an acquisition, and markup in text for the report."""

import json
from html.parser import HTMLParser

import numpy as np
from astropy.io import fits

from fuzzing.laws import RUNTIME, Broken, Case, Kind, describe_calibration, encodable, pixcal
from fuzzing.night import Night

GLOBS = (
    "../*.fits",
    "x/../../*.fits",
    "..",
    "../",
    "a/../b/*.fits",
    "/etc/passwd",
    "/**",
    "//etc/*",
    "~/*.fits",
    "$HOME/*",
    "**",
    "**/*.fits",
    "**/**/**/*",
    "*",
    ".",
    "./",
    "./b/*.fits",
    "**x",
    "***",
    "[",
    "[a",
    "[!a]*",
    "b/[a-]*",
    "b/?.fits",
    "b/*.FITS",
    "b//x.fits",
    "b/x.fits/",
    "b/x.fits",
    "b/./x.fits",
    "\\*",
    "b\\x.fits",
    "circle/**/*.fits",
    "circle/*/*/*.fits",
    "out/*.fits",
    "out/**/*.fits",
    ".hidden/*.fits",
    ".*",
    "*/.*",
    "b/x.fits\n",
    "b/\x00",
    " ",
    "é/*.fits",
    "\udcff*",
    "C:/x.fits",
    "file:///etc/passwd",
    "http://localhost/x",
    "`id`",
    "%s",
    "{b,c}/*.fits",
    "b/" + "x" * 300,
    "b/" + "*" * 200 + ".fits",
    "/".join("b" * 3000),
    "dev/*",
    "broken",
    "*/x.fits",
    "self.yaml",
    "acquisition.yaml",
    "empty",
    "<b>",
    "b/{{7*7}}",
)
MARKUP = (
    "<script id=pwned>alert(1)</script>",
    '"><img pwned src=x onerror=alert(1)>',
    "</style><b pwned>",
    "' onload='pwned",
    "<!-- pwned",
    "]]><x pwned>",
    "{{ 7 * 7 }}pwned",
    "{% raw %}pwned",
    "${pwned}",
    "&lt;b pwned&gt;",
    "</svg><a pwned href=javascript:x>",
    "<iframe pwned>",
    "\\u003cb pwned",
    "</script><script pwned>",
    "[bold red]pwned[/bold red]",
    "[/]pwned",
    "%(pwned)s",
    "pwned\\",
    "\N{RIGHT-TO-LEFT OVERRIDE}pwned",
    "$pwned^{2$",
    "$\\frac{pwned}$",
    "`pwned`",
)


def _elsewhere(case: Case) -> None:
    """Globs that leave the folder of the acquisition, and what lies in their way."""
    acq = case.folder / "acq"
    (acq / "b").mkdir(parents=True)
    (acq / "dev").mkdir()
    (acq / ".hidden").mkdir()
    outside = case.folder / "outside"
    outside.mkdir()
    for file in (
        acq / "b/x.fits",
        acq / ".hidden/h.fits",
        outside / "o.fits",
        case.folder / "s.fits",
    ):
        fits.PrimaryHDU(np.full((5, 7), 100, np.int16)).writeto(file)
    (acq / "circle").symlink_to(acq)
    (acq / "circle2").symlink_to(acq)
    (acq / "b/circle").symlink_to(acq)
    (acq / "out").symlink_to(outside)
    (acq / "broken").symlink_to(acq / "nothing")
    (acq / "dev/null").symlink_to("/dev/null")
    (acq / "dev/zero").symlink_to("/dev/zero")
    (acq / "empty").touch()
    globs = [str(case.pick(*GLOBS)) for _ in range(int(case.rng.integers(1, 3)))]
    describe_calibration(acq, **{str(case.pick("bias", "dark", "flat")): globs})
    run = case.folder / "run"
    pixcal("ingest", acq, "--out", run, *RUNTIME, names=["frames", "acq/"])
    (table,) = json.loads((run / "ingest" / "frames.json").read_text()).values()
    for name in table["file"]:
        there = (acq / name).resolve()
        # A link that is named in a glob is the user's own way out; '..' and '/' are none.
        if not there.is_relative_to(acq.resolve()) and not name.startswith("out/"):
            raise Broken(f"{globs}: took {there}")


class _Page(HTMLParser):
    """Tags, attributes and comments of a page that hold the word of `MARKUP`."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        handlers = [name for name in names if name.startswith("on")]
        if "pwned" in names or ("id", "pwned") in attrs or handlers or tag == "iframe":
            self.found.append(f"<{tag} {attrs}>")

    def handle_comment(self, data: str) -> None:
        if "pwned" in data:
            self.found.append(f"<!--{data}-->")

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def _markup(case: Case) -> None:
    """Markup in the detector's name, in names of files, and in header strings."""
    night = Night(case.rng, (16, 18), count=20)
    text = str(case.pick(*MARKUP))
    night.described["detector"]["name"] = text
    acq = night.write(case.folder / "acq")
    name = text.replace("/", "_")
    if encodable(name):
        for number in (2, 1):
            target = acq / f"{name}{number}.fits"
            data = night.frames["bias"][number::2].round().astype("uint16")
            hdu = fits.PrimaryHDU(data)
            if text.isascii():
                hdu.header["OBJECT"] = text[:60]
            # In the wrong order, so that a warning names the file.
            hdu.header["MJD-OBS"] = 60000.0 + (2 - number)
            hdu.writeto(target)
        night.described["frames"]["bias"] = ["*[12].fits"]
        (acq / "acquisition.yaml").write_text(json.dumps(night.described))
    run = case.folder / "run"
    pixcal("ingest", acq, "--out", run, *RUNTIME, names=["detector", "acq/"])
    for command in ("reduce", "report"):
        pixcal(command, run, *RUNTIME, names=[str(run)])
    page = _Page()
    page.feed((run / "products" / "report.html").read_text(encoding="utf-8"))
    page.close()
    if page.found:
        raise Broken(f"the report takes {text!r} for markup: {page.found[0]:.200}")
    if text not in "".join(page.text):
        raise Broken(f"the report does not show {text!r} as it is")


KINDS = [
    Kind("globs", "globs: `..`, absolute paths, circular links", _elsewhere, 500),
    Kind("markup", "markup in names, files and headers", _markup, 30),
]
