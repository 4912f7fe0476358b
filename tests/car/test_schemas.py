"""The JSON Schemas of a car's parts and of plans match their models; ``PDHEF_UPDATE_SCHEMAS=1`` regenerates them."""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from pdhef_logtool.car.car import SHIPPED_CARS
from pdhef_logtool.car.parts import FilterNoise, Fit, FittedPhysics, LearntOn
from pdhef_logtool.car.toml_files import VehicleEntries, part_toml
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.evaluation.validation_plan import PlanTable
from pdhef_logtool.results.parquet_sink import load_schema

FOLDER = Path(__file__).parents[2] / "schemas"
#: By the name of the schema.
MODELS: dict[str, Any] = {"car-vehicle": VehicleEntries, "car-fit": Fit, "plan": PlanTable}
FIT = Fit(
    physics_sha256="ab" * 32,
    physics=FittedPhysics(values=default_vehicle(), noise=FilterNoise()),
    filter={"phy-ukf:tuned": FilterNoise(q_std=(0.1, 0.1, 0.1), r_std={"ay_m_s2": 1.0})},
    drives=(LearntOn(name="lap", sha256="cd", end_s=9.0),),
)


def said_by_the_model(name: str) -> str:
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"{name}.schema.json"}
    return json.dumps({**head, **MODELS[name].model_json_schema()}, indent=2, ensure_ascii=False) + "\n"


def document(part: str) -> dict[str, Any]:
    """Return one that pdhef wrote."""
    if part == "fit":
        return tomllib.loads(part_toml(FIT, "Written by a test."))
    path = next(SHIPPED_CARS["saloon"].glob(f"{part}.[tj]*"))
    return json.loads(path.read_text()) if path.suffix == ".json" else tomllib.loads(path.read_text())


def valid(part: str, value: dict[str, Any]) -> bool:
    return bool(jsonschema.Draft202012Validator(load_schema(f"car-{part}.schema.json")).is_valid(value))


@pytest.mark.parametrize("name", MODELS)
def test_a_schema_is_what_its_model_says(name: str) -> None:
    path = FOLDER / f"{name}.schema.json"
    if os.environ.get("PDHEF_UPDATE_SCHEMAS") == "1":
        path.write_text(said_by_the_model(name), encoding="utf-8")
    assert path.read_text(encoding="utf-8") == said_by_the_model(name), "PDHEF_UPDATE_SCHEMAS=1 writes it again"
    jsonschema.Draft202012Validator.check_schema(load_schema(path.name))


@pytest.mark.parametrize("part", ["vehicle", "fit"])
def test_what_pdhef_wrote_is_valid_and_what_it_refuses_is_not(part: str) -> None:
    written = document(part)
    assert valid(part, written)
    assert not valid(part, written | {"no_such_entry": 1})
    for name in MODELS[f"car-{part}"].model_json_schema().get("required", []):
        assert not valid(part, {k: v for k, v in written.items() if k != name}), name
    if part != "vehicle":
        assert not valid(part, written | {"version": 99})
        assert not valid(part, written | {"format": "pdhef-else"})
