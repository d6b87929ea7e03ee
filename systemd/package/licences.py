"""Prints each package of this interpreter's venv with its version and the licence that it declares."""

from importlib.metadata import distributions

for package in sorted(distributions(), key=lambda one: one.name.lower()):
    about = package.metadata.json
    if package.name == "corridor":
        continue
    classified = [
        one.rpartition(" :: ")[2] for one in about.get("classifier", []) if one.startswith("License ::")
    ]
    words = str(about.get("license", "")).partition("\n")[0] or ", ".join(classified)
    print(f"{package.name} {package.version}: {about.get('license_expression') or words}")
