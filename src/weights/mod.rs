//! Where a model's weights are: `--weights`, `SAT3D_WEIGHTS`, the Hugging Face cache.
