"""Settings files in TOML: target profiles, release manifests, adapters, with one reader."""
