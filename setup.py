"""Ships the folder ``schemas/`` inside the package; everything else stands in pyproject.toml."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["pdhef_logtool*", "truthsim*"]), "pdhef_logtool.schemas"],
    package_dir={"pdhef_logtool.schemas": "schemas"},
    package_data={
        "pdhef_logtool": [
            "py.typed",
            "models/*/*",
            "models/*/*/*",
            "models/*/*/*/*",
            "models/*/*/*/*/*",
            "*/*.toml",
            "*/templates/*",
            "reports/assets/*",
        ],
        "truthsim": ["py.typed", "vehicles/*.toml"],
        "pdhef_logtool.schemas": ["*.json", "*.md", "*/msg/*.msg"],
    },
)
