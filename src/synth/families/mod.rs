//! Generates, for each family, a scene of labelled primitives from random choices.
//!
//! In every scene +y is up, and fronts face +z. A scene is about one unit high and no part is
//! thinner than 0.025 in radius, so that a mesh of a few thousand faces can represent it.

pub(super) mod animal;
pub(super) mod bird;
pub(super) mod candelabra;
pub(super) mod chair;
pub(super) mod container;
pub(super) mod guitar;
pub(super) mod pliers;
