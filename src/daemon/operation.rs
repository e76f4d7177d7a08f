//! A request becomes one operation, sorted by what it needs.
//!
//! The table below is the only list of requests in the daemon. Each kind has one handler, which
//! takes the enum of that kind, so every match is total: the compiler rejects a request of the
//! protocol that is missing in the table, and a row of the table that is missing in its handler.

use crate::ipc::convert::{self, NamedFrames};
use crate::ipc::keys::Role;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, request::Body};
use crate::library::RequestKey;

/// An operation, by what it needs.
#[allow(clippy::large_enum_variant)] // moved a few times for each request, never in a collection
#[derive(Debug)]
pub(crate) enum Operation {
    /// Needs nothing that may be busy: it shows that the daemon lives.
    Hello,
    /// Reads rows.
    Look(Look),
    /// Copies whole files or arrays.
    Fetch(Fetch),
    /// Computes an answer from shapes, in a worker.
    Compute(Compute),
    /// Changes a collection, in the daemon itself.
    Change(Change),
    /// Changes the labels of a collection, in a worker.
    Edit(Edit),
    /// Changes something that additions depend on, so it waits for all additions before it.
    Settle(Settle),
    /// Adds shapes.
    Add(wire::AddShapesRequest),
    /// Waits for something to happen, without a thread.
    Wait(Wait),
    /// Ends the daemon, after all additions before it.
    Drain,
}

/// The work of a worker that opens the library for a request.
#[allow(clippy::large_enum_variant)] // one at a time for each worker
#[derive(Debug)]
pub(crate) enum Remote {
    Compute(Compute),
    Edit(Edit),
}

/// The cost of a read. A short one does not wait for those that copy much.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Cost {
    Short,
    Bulk,
}

/// Defines one kind from rows `Name(Message) [checked by a function of convert]`.
macro_rules! kind {
    (
        $(#[$doc:meta])*
        $kind:ident {
            $( $name:ident($message:ident) $(checked by $check:ident)? ),+ $(,)?
        }
    ) => {
        $(#[$doc])*
        #[allow(clippy::large_enum_variant)] // as in `Operation`
        #[derive(Debug)]
        pub(crate) enum $kind { $( $name(wire::$message) ),+ }

        impl $kind {
            /// Checks the values that need no library, and notes the frames that fields name.
            fn check(&self, _frames: &mut NamedFrames) -> Result<(), wire::Error> {
                match self {
                    $( Self::$name(_request) => {
                        $( convert::$check(_request, _frames)?; )?
                        Ok(())
                    } )+
                }
            }
        }

        impl From<$kind> for Body {
            fn from(operation: $kind) -> Self {
                match operation {
                    $( $kind::$name(request) => Self::$name(request) ),+
                }
            }
        }
    };
}

/// Defines all kinds. A row's name is that of the request's field in `message.proto`.
macro_rules! operations {
    (
        anywhere { $(
            $(#[$doc:meta])*
            $kind:ident { $( $name:ident($message:ident) $(checked by $check:ident)? ),+ $(,)? }
        )+ }
        of_one_collection { $(
            $(#[$doc_in:meta])*
            $kind_in:ident {
                $( $name_in:ident($message_in:ident) $(checked by $check_in:ident)? ),+ $(,)?
            }
        )+ }
    ) => {
        $( kind! { $(#[$doc])* $kind { $( $name($message) $(checked by $check)? ),+ } } )+
        $(
            kind! {
                $(#[$doc_in])*
                $kind_in { $( $name_in($message_in) $(checked by $check_in)? ),+ }
            }

            impl $kind_in {
                /// The collection that it reads or changes.
                pub(crate) fn collection(&self) -> &str {
                    match self {
                        $( Self::$name_in(request) => &request.collection ),+
                    }
                }
            }
        )+

        impl From<Body> for Operation {
            fn from(body: Body) -> Self {
                match body {
                    Body::Hello(_) => Self::Hello,
                    Body::AddShapes(request) => Self::Add(request),
                    Body::Drain(_) => Self::Drain,
                    $($( Body::$name(request) => Self::$kind($kind::$name(request)), )+)+
                    $($(
                        Body::$name_in(request) => Self::$kind_in($kind_in::$name_in(request)),
                    )+)+
                }
            }
        }

        impl Operation {
            /// Refuses a request that came with so many raw frames and is wrong whatever the
            /// library has.
            pub(crate) fn check(&self, n_frames: usize) -> Result<(), wire::Error> {
                let mut frames = NamedFrames::default();
                match self {
                    Self::Hello | Self::Drain => {}
                    Self::Add(request) => convert::check_addition(request, &mut frames)?,
                    $( Self::$kind(operation) => operation.check(&mut frames)?, )+
                    $( Self::$kind_in(operation) => operation.check(&mut frames)?, )+
                }
                frames.check(n_frames)
            }
        }
    };
}

operations! {
    anywhere {
        /// Answered from rows.
        Look {
            Stats(StatsRequest),
            ListCollections(ListCollectionsRequest),
            DescribeCollection(DescribeCollectionRequest),
            GetJob(GetJobRequest),
            ListJobs(ListJobsRequest),
            ListShapes(ListShapesRequest) checked by check_reviews,
            GetShape(GetShapeRequest),
            GetLabels(GetLabelsRequest),
            EventsSince(EventsSinceRequest),
            ListLinks(ListLinksRequest),
        }
        /// Answered with whole files or arrays.
        Fetch {
            GetOriginal(GetOriginalRequest),
            LabelsSnapshot(LabelsSnapshotRequest),
            GetDescriptors(GetDescriptorsRequest),
            Publish(PublishRequest),
            GetArrayFile(GetArrayFileRequest),
        }
        /// Changes in order with additions.
        Settle {
            CreateCollection(CreateCollectionRequest) checked by check_creation,
            CancelJob(CancelJobRequest),
            RetryJob(RetryJobRequest),
        }
        /// Answered when something has happened.
        Wait {
            WatchJob(WatchJobRequest),
            WaitIdle(WaitIdleRequest),
        }
    }
    of_one_collection {
        /// Computed from shapes in a worker, unless the result is stored.
        Compute {
            GetSpectrum(GetSpectrumRequest) checked by check_spectrum,
            GetHks(GetHksRequest) checked by check_hks,
            GetFunctionalMap(GetFunctionalMapRequest) checked by check_map,
            TransferFunction(TransferFunctionRequest) checked by check_transfer,
            GetPartCorrespondence(GetPartCorrespondenceRequest),
            Nearest(NearestRequest),
            GetPortraits(GetPortraitsRequest) checked by check_portraits,
            SuggestNext(SuggestNextRequest),
            NextQuestion(NextQuestionRequest),
            ListProposals(ListProposalsRequest),
            GetProposal(GetProposalRequest),
        }
        /// Changes that take no work on shapes.
        Change {
            DeleteCollection(DeleteCollectionRequest),
            NameLabel(NameLabelRequest),
        }
        /// Changes of labels that a worker makes.
        Edit {
            UpdateCollection(UpdateCollectionRequest) checked by check_update,
            CorrectLabels(CorrectLabelsRequest) checked by check_correction,
            AnswerQuestion(AnswerQuestionRequest),
            ReviewShape(ReviewShapeRequest) checked by check_review,
            MergeLabels(MergeLabelsRequest),
            SplitLabel(SplitLabelRequest),
            ChooseProposal(ChooseProposalRequest),
            LinkParts(LinkPartsRequest) checked by check_link,
            UnlinkParts(UnlinkPartsRequest),
            Undo(UndoRequest),
            RemoveShape(RemoveShapeRequest),
        }
    }
}

impl Operation {
    /// The least role that may request it.
    pub(crate) fn role(&self) -> Role {
        match self {
            Self::Hello | Self::Look(_) | Self::Fetch(_) | Self::Compute(_) | Self::Wait(_) => {
                Role::ReadOnly
            }
            Self::Add(_)
            | Self::Edit(_)
            | Self::Change(Change::NameLabel(_))
            | Self::Settle(Settle::CreateCollection(_) | Settle::CancelJob(_)) => Role::Ingest,
            Self::Change(Change::DeleteCollection(_))
            | Self::Settle(Settle::RetryJob(_))
            | Self::Drain => Role::Admin,
        }
    }

    /// The cost of reading its answer from rows and arrays.
    pub(crate) fn cost(&self) -> Cost {
        match self {
            Self::Fetch(_)
            | Self::Compute(
                Compute::GetPortraits(_)
                | Compute::GetSpectrum(_)
                | Compute::GetHks(_)
                | Compute::GetProposal(_),
            ) => Cost::Bulk,
            _ => Cost::Short,
        }
    }
}

impl Remote {
    /// The collection that it reads or changes.
    pub(crate) fn collection(&self) -> &str {
        match self {
            Self::Compute(compute) => compute.collection(),
            Self::Edit(edit) => edit.collection(),
        }
    }
}

impl From<Remote> for Body {
    fn from(remote: Remote) -> Self {
        match remote {
            Remote::Compute(compute) => compute.into(),
            Remote::Edit(edit) => edit.into(),
        }
    }
}

impl TryFrom<Operation> for Remote {
    type Error = Operation;

    fn try_from(operation: Operation) -> Result<Self, Operation> {
        match operation {
            Operation::Compute(compute) => Ok(Self::Compute(compute)),
            Operation::Edit(edit) => Ok(Self::Edit(edit)),
            other => Err(other),
        }
    }
}

/// The refusal of a request without a body, or with one of a later version.
pub(crate) fn unknown_request() -> wire::Error {
    convert::error(
        ErrorCode::InvalidArgument,
        ErrorReason::UnknownRequest,
        "the request has no body that this version knows",
    )
}

/// The idempotency key of a request, if its client has a name. The name belongs to the key of its
/// `owner`, if connections are authenticated: a client of the same name with another key is another
/// client.
pub(crate) fn request_key(
    client_id: &str,
    request_id: &str,
    owner: Option<&str>,
) -> Option<RequestKey> {
    (!client_id.is_empty()).then(|| RequestKey {
        client_id: match owner {
            // Keys have no space, and one length.
            Some(owner) => format!("{owner} {client_id}"),
            None => client_id.to_owned(),
        },
        request_id: request_id.to_owned(),
    })
}
