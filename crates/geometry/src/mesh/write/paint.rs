//! Gives primitives of a glTF file the material of their label, beside their own.

use super::glb::{Document, field, list};
use super::gltf::index;
use super::{Labelling, Materials};
use serde_json::{Value, json};

const VARIANTS: &str = "KHR_materials_variants";

/// Chooses which material a primitive shows; the other one is in a variant.
pub(super) struct Painter {
    materials: Materials,
    /// The variant of materials that was added.
    variant: Option<usize>,
}

impl Painter {
    pub(super) fn new(materials: Materials) -> Self {
        let variant = None;
        Self { materials, variant }
    }

    pub(super) fn paint(
        &mut self,
        document: &mut Document,
        primitive: &mut Value,
        (label, labelling): (i32, &Labelling<'_>),
    ) {
        let of_label = document.material(label, labelling);
        let Some(own) = index(&primitive["material"]) else {
            primitive["material"] = of_label.into();
            return;
        };
        let (shown, other, name) = match self.materials {
            Materials::Own => (own, of_label, "labels"),
            Materials::Labels => (of_label, own, "original"),
        };
        primitive["material"] = shown.into();
        let variant = match self.variant {
            Some(variant) => variant,
            None => {
                let used = document.list("extensionsUsed");
                if !used.iter().any(|name| name == VARIANTS) {
                    used.push(VARIANTS.into());
                }
                let extensions = field(&mut document.root, "extensions");
                let variants = list(field(extensions, VARIANTS), "variants");
                variants.push(json!({ "name": name }));
                *self.variant.insert(variants.len() - 1)
            }
        };
        let extensions = field(primitive, "extensions");
        let mappings = list(field(extensions, VARIANTS), "mappings");
        mappings.push(json!({ "material": other, "variants": [variant] }));
    }
}
