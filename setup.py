"""What pyproject.toml cannot say: ``conf/`` of a checkout is installed as ``nlos_lit/conf``."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["nlos_lit*", "data_modules*"]), "nlos_lit.conf"],
    package_dir={"nlos_lit.conf": "conf"},
    package_data={"nlos_lit.conf": ["**/*.yaml"], "": ["py.typed", "*.css", "*.js", "*.html"]},
)
