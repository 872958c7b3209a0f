//! The terms of the objectives. Each is a function of tensors and knows nothing of weights of terms.
