//! Defines the codes and reasons of failures. Their names are those on the wire, and are stored
//! with failed shapes.

use serde::{Deserialize, Serialize};

/// Defines an enum whose variants have names that are stored and sent.
macro_rules! named {
    ($(#[$meta:meta])* $type:ident { $($variant:ident = $name:literal),+ $(,)? }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
        #[allow(missing_docs)] // the names say it
        pub enum $type {
            $(#[serde(rename = $name)] $variant,)+
            /// A name that this version does not know.
            #[serde(other, rename = "UNSPECIFIED")]
            Unspecified,
        }

        impl $type {
            /// All variants that have a name.
            pub const ALL: &[Self] = &[$(Self::$variant),+];

            /// Returns the stored name.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)+
                    Self::Unspecified => "UNSPECIFIED",
                }
            }
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}

named!(
    /// The kind of a failure.
    Code {
        AlreadyExists = "ALREADY_EXISTS",
        Cancelled = "CANCELLED",
        DataLoss = "DATA_LOSS",
        DeadlineExceeded = "DEADLINE_EXCEEDED",
        FailedPrecondition = "FAILED_PRECONDITION",
        Internal = "INTERNAL",
        InvalidArgument = "INVALID_ARGUMENT",
        NotFound = "NOT_FOUND",
        ResourceExhausted = "RESOURCE_EXHAUSTED",
    }
);

named!(
    /// A stable reason within a code.
    Reason {
        BadName = "BAD_NAME",
        Cancelled = "CANCELLED",
        CollectionExists = "COLLECTION_EXISTS",
        Damaged = "DAMAGED",
        FaceIndex = "FACE_INDEX",
        FieldRange = "FIELD_RANGE",
        Gone = "GONE",
        LabelCount = "LABEL_COUNT",
        LabelLimit = "LABEL_LIMIT",
        LabelMerged = "LABEL_MERGED",
        LabelRange = "LABEL_RANGE",
        LabelTooSmall = "LABEL_TOO_SMALL",
        LabelledByPerson = "LABELLED_BY_PERSON",
        Laplacian = "LAPLACIAN",
        LinkContradicts = "LINK_CONTRADICTS",
        LinkLimit = "LINK_LIMIT",
        Mesh = "MESH",
        MeshTooLarge = "MESH_TOO_LARGE",
        NameTaken = "NAME_TAKEN",
        NoArea = "NO_AREA",
        NoCollection = "NO_COLLECTION",
        NoJob = "NO_JOB",
        NoLabel = "NO_LABEL",
        NoLink = "NO_LINK",
        NoProposals = "NO_PROPOSALS",
        NoShape = "NO_SHAPE",
        NoSpace = "NO_SPACE",
        NoVersion = "NO_VERSION",
        NonFiniteVertex = "NON_FINITE_VERTEX",
        NotPublishable = "NOT_PUBLISHABLE",
        NothingCorrected = "NOTHING_CORRECTED",
        NothingToAsk = "NOTHING_TO_ASK",
        NothingToSuggest = "NOTHING_TO_SUGGEST",
        NothingToUndo = "NOTHING_TO_UNDO",
        NPartsRange = "N_PARTS_RANGE",
        OriginalGone = "ORIGINAL_GONE",
        Panic = "PANIC",
        Parse = "PARSE",
        PartIndex = "PART_INDEX",
        ProposalsChanged = "PROPOSALS_CHANGED",
        ReadOnly = "READ_ONLY",
        RequestIdReused = "REQUEST_ID_REUSED",
        ShapeMemory = "SHAPE_MEMORY",
        ShapeTimeout = "SHAPE_TIMEOUT",
        Spectrum = "SPECTRUM",
        Store = "STORE",
        VertexIndex = "VERTEX_INDEX",
        WorkerDied = "WORKER_DIED",
        WorkingFacesRange = "WORKING_FACES_RANGE",
    }
);

#[cfg(test)]
mod tests {
    use super::{Code, Reason};

    #[test]
    fn names_come_back_and_unknown_ones_are_read() {
        for reason in Reason::ALL {
            let text = serde_json::to_string(reason).expect("text");
            assert_eq!(text, format!("{:?}", reason.name()));
            assert_eq!(
                serde_json::from_str::<Reason>(&text).expect("reads"),
                *reason
            );
        }
        for code in Code::ALL {
            let text = format!("{:?}", code.name());
            assert_eq!(serde_json::from_str::<Code>(&text).expect("reads"), *code);
        }
        let unknown: Reason = serde_json::from_str("\"TOMORROW\"").expect("reads");
        assert_eq!(unknown, Reason::Unspecified);
    }
}
