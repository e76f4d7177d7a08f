//! The grammars: for each family, dice become a scene of labelled primitives.
//!
//! Everywhere +y is up; what has a front faces +z. A scene is about one unit high and no part is thinner
//! than 0.025 in radius, so that a mesh of a few thousand faces can hold it.

pub(super) mod animal;
pub(super) mod bird;
pub(super) mod candelabra;
pub(super) mod chair;
pub(super) mod container;
pub(super) mod guitar;
pub(super) mod pliers;
