"""Where the mathematics is from, as BibTeX: this software, the thesis, and the sources of the estimators."""

from __future__ import annotations

from collections.abc import Sequence

from stochfuse import __version__
from stochfuse.scenario import registry

BIBTEX = {
    "stochfuse": f"""@software{{stochfuse,
  title   = {{stochfuse: expected accuracy of distributed Kalman fusion over radio links that lose messages}},
  version = {{{__version__}}},
  license = {{Apache-2.0}}
}}""",
    "martin2005": """@mastersthesis{martin2005,
  author = {Martin, Todd},
  title  = {Distributed Information Fusion in Communications Networks with Ad Hoc Connectivity and
            Non-Deterministic Link Characteristics},
  school = {George Mason University},
  year   = {2005}
}""",
    "julier1997": """@inproceedings{julier1997,
  author    = {Julier, Simon J. and Uhlmann, Jeffrey K.},
  title     = {A Non-divergent Estimation Algorithm in the Presence of Unknown Correlations},
  booktitle = {Proceedings of the American Control Conference},
  year      = {1997},
  pages     = {2369--2373}
}""",
    "julier2004": """@misc{julier2004,
  author = {Julier, Simon J. and Uhlmann, Jeffrey K.},
  title  = {Method and Apparatus for Fusing Signals with Partially Known Independent Error Components},
  note   = {US Patent 6,829,568},
  year   = {2004}
}""",
    "layh2017": """@article{layh2017,
  author  = {Layh, T. and Gebre-Egziabher, D.},
  title   = {Design for Graceful Degradation and Recovery from {GNSS} Interruptions},
  journal = {IEEE Aerospace and Electronic Systems Magazine},
  volume  = {32},
  number  = {9},
  year    = {2017}
}""",
    "uncertain-fusion": """@misc{uncertain-fusion,
  title = {Extended {Kalman} filter fusion estimation with uncertain effects, verified on {GPS/INS} navigation},
  note  = {the equivalent measurement and its error matrix; supported by NSFC 50974103}
}""",
    "li2021": """@misc{li2021,
  author = {Li, R. and Yoo, C. J.},
  title  = {Estimator for Determining an Update to an Estimated Local State Vector},
  note   = {patent application, filed 21 April 2021},
  year   = {2021}
}""",
}


def cited(words: Sequence[str]) -> str:
    """Return BibTeX for what a command line asks for: the software, the thesis, and the sources of its estimators.

    Parameters
    ----------
    words : of the command line; estimators are what follows --estimator, --estimators, --method or --methods.
    """
    keys = ["stochfuse", "martin2005"]
    options = ("--estimator", "--method", "--methods")
    for before, word in zip(["", *words], words, strict=False):
        flag, _, given = word.partition("=")
        named = given if flag in options else word if before in options else ""
        for entry in registry.ESTIMATOR:
            if entry.name in named.split(",") or named == "all":
                keys += [key for key in entry.cites if key not in keys]
    return "\n\n".join(BIBTEX[key] for key in keys) + "\n"
