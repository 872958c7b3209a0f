//! Inference over one image or a batch: DSM, mesh, views.
