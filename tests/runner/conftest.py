from tests.support.toys import problems, project, registry, run, scans, write_config

__all__ = ["problems", "project", "registry", "run", "scans", "write_config"]
