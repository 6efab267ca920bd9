"""Example models as FMUs: C sources in `src/`, built for this machine by `fmus.build`."""
