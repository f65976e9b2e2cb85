from tests.support.toys import project, registry, run, scans, write_config

__all__ = ["project", "registry", "run", "scans", "write_config"]
