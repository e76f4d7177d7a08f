//! Parses the command line into one command with typed flags.

mod bundles;
mod care;
mod maps;
mod corrections;
mod links;
mod looking;
mod proposals;
mod questions;

pub(crate) use bundles::{LabelMeshes, Publish};
pub(crate) use care::{Cancel, Jobs, Keys, KeysCommand, Restore, Retry, Snapshot, Stop};
pub(crate) use corrections::{Correct, Merge, Render, Split, Suggest, Undo};
pub(crate) use links::{LinkParts, Links, Unlink};
pub(crate) use looking::{Top, Usd, View};
pub(crate) use maps::{Map, Resolution, Transfer};
pub(crate) use proposals::{Choose, Proposals};
pub(crate) use questions::{AnswerQuestion, Approve, Ask, Verdict};

use crate::commands::demo::DemoArgs;
use crate::commands::describe::Describe;
use crate::commands::synth::SynthArgs;
use clap::{Args, Parser, Subcommand, ValueEnum};
use coseg::ipc::convert::parse_up;
use coseg::ipc::wire;
use coseg::library::MAX_PARTS;
use coseg::operators;
use std::path::PathBuf;
use std::time::Duration;

/// Exit codes, as listed by `coseg --help`.
pub(crate) mod exit {
    /// Something failed: a shape was refused, a named item does not exist, a check found damage.
    pub(crate) const FAILED: u8 = 1;
    /// The command line or the configuration is wrong; clap uses the same.
    pub(crate) const USAGE: u8 = 2;
    /// No daemon answered within the timeout.
    pub(crate) const NO_ANSWER: u8 = 3;
}

const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  failed: a shape was refused, what was named is not there, a check found damage
  2  the command line or the configuration is wrong
  3  no answer from a daemon within --timeout

Data goes to stdout, words to stderr. Settings of the daemon: coseg config show.";

/// Keeps a growing library of 3D shapes consistently segmented and labelled.
#[derive(Debug, Parser)]
#[command(name = "coseg", version, after_help = EXIT_CODES, arg_required_else_help = true)]
pub(crate) struct Cli {
    #[command(flatten)]
    pub(crate) global: Global,
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// Flags that every command accepts.
#[derive(Debug, Clone, Args)]
pub(crate) struct Global {
    /// Address of the daemon: ipc://PATH or tcp://HOST:PORT [default: the daemon's own default
    /// socket]
    #[arg(
        long,
        global = true,
        env = "COSEG_ENDPOINT",
        value_name = "URI",
        hide_env_values = true
    )]
    pub(crate) endpoint: Option<String>,
    /// The daemon's public key, if it has keys: the server.pub that `coseg keys generate --server`
    /// writes
    #[arg(
        long,
        global = true,
        env = "COSEG_SERVER_KEY",
        value_name = "FILE",
        hide_env_values = true
    )]
    pub(crate) server_key: Option<PathBuf>,
    /// This client's keys, as written by `coseg keys generate NAME`
    #[arg(
        long,
        global = true,
        env = "COSEG_CLIENT_KEY",
        value_name = "FILE",
        hide_env_values = true
    )]
    pub(crate) client_key: Option<PathBuf>,
    /// Seconds to wait for an answer; the command still waits for running work beyond that
    #[arg(long, global = true, value_name = "SECONDS", default_value = "5", value_parser = seconds)]
    pub(crate) timeout: Duration,
    /// Print only JSON on stdout
    #[arg(long, global = true)]
    pub(crate) json: bool,
}

pub(crate) fn seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text
        .parse()
        .map_err(|_| format!("{text:?} is not a number of seconds"))?;
    match Duration::try_from_secs_f64(seconds) {
        Ok(duration) if !duration.is_zero() && seconds <= 86_400.0 => Ok(duration),
        _ => Err(format!("{seconds} s is not between 0 and 86400")),
    }
}

/// The command to run.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Run the daemon
    Serve(Serve),
    /// Add meshes, and wait until they are labelled
    Add(Add),
    /// Wait until a collection has no work left
    Wait(Wait),
    /// List collections, or the shapes of one
    Ls(Ls),
    /// Show one shape, or the collection if no shape is named
    Show(Show),
    /// Print a shape's labels, one for each face of its file
    Labels(Labels),
    /// Write labels, or coloured meshes, of a collection to a folder
    Export(Export),
    /// Write all that labels new shapes of a collection to one file, for `coseg label`
    Publish(Publish),
    /// Label meshes by a file of `coseg publish`, without a daemon
    Label(LabelMeshes),
    /// Label the meshes of OpenUSD assets, or correct labels there (needs the package coseg[usd])
    #[command(disable_help_flag = true)]
    Usd(Usd),
    /// Draw a collection in the colours of its labels as one PNG
    Render(Render),
    /// Write a collection with the viewer as one self-contained HTML file
    View(View),
    /// Show the functional map between two shapes and the parts that it matches
    Map(Map),
    /// Transfer labels or functions at the faces of one shape to another
    Transfer(Transfer),
    /// List the shapes most similar to one shape
    Nearest(Nearest),
    /// Remove shapes
    Rm(Rm),
    /// Follow events as they happen
    Watch(Watch),
    /// List the events in a collection's log
    Events(Events),
    /// Name the shape most worth labelling by hand next, and the reason
    Suggest(Suggest),
    /// Ask for the label of one part after the other, those first whose answers are worth most
    Ask(Ask),
    /// Answer a question of `coseg ask`
    Answer(AnswerQuestion),
    /// Find all labels of a shape right, which makes it one that others are labelled from
    Approve(Approve),
    /// Label a shape by hand, and propagate that to all others
    Correct(Correct),
    /// Give a label a name
    Name(Name),
    /// Merge two labels into one
    Merge(Merge),
    /// Split one label into two
    Split(Split),
    /// List proposals: other divisions of the shapes into labels, from coarse to fine
    Proposals(Proposals),
    /// Make one of the proposals the labels
    Choose(Choose),
    /// Demand that two parts have the same label
    Same(LinkParts),
    /// Demand that two parts have different labels
    Differ(LinkParts),
    /// List the links between parts that `coseg same` and `coseg differ` made
    Links(Links),
    /// Remove a link between parts
    Unlink(Unlink),
    /// Undo the newest correction, answer, verdict, name, merge, split, link, change of the up axis
    /// or choice; repeat to go further back
    Undo(Undo),
    /// Create, change or delete collections
    #[command(subcommand)]
    Collections(Collections),
    /// Show counters of the daemon
    Stats,
    /// Follow queue, rates and stages of the daemon
    Top(Top),
    /// Let the daemon finish its current work and stop
    Stop(Stop),
    /// Compute the spectrum and descriptors of one mesh, without a daemon
    Describe(Describe),
    /// Generate a family of labelled shapes
    Synth(SynthArgs),
    /// Run the whole pipeline on a generated family, in a temporary library
    Demo(DemoArgs),
    /// List jobs, or the failed shapes with their errors
    Jobs(Jobs),
    /// Queue the failed shapes of a job again
    Retry(Retry),
    /// Cancel the shapes of a job that are not yet placed
    Cancel(Cancel),
    /// Generate keys, and manage the clients that may connect
    Keys(Keys),
    /// Describe shapes for a daemon, which starts this command itself
    #[command(hide = true)]
    Worker,
    /// Verify a library's files against its catalog; needs no daemon, and may run beside one
    Check(Check),
    /// Copy a library, even while a daemon uses it, and verify the copy; needs no daemon
    Snapshot(Snapshot),
    /// Create a library from a snapshot
    Restore(Restore),
    /// Check or show the daemon's configuration
    #[command(subcommand)]
    Config(ConfigCommand),
    /// Print the completions of a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
    /// Print the manual page, or write one for each command
    Man {
        /// Folder for all pages, created if missing
        #[arg(long, value_name = "DIR")]
        out: Option<PathBuf>,
    },
}

/// `coseg serve`
#[derive(Debug, Args)]
pub(crate) struct Serve {
    /// Folder of the library, created if missing [default: shown by `coseg config show`]
    #[arg(long, value_name = "DIR")]
    pub(crate) library: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) file: ConfigFile,
    /// Folder of keys; with keys, connections are encrypted and authenticated, also from other
    /// machines
    #[arg(long, value_name = "DIR")]
    pub(crate) keys: Option<PathBuf>,
    /// Serve the viewer, /metrics, /healthz and /readyz over HTTP, at a loopback address such as
    /// 127.0.0.1:8640. Keys do not protect it; beyond loopback (http.allow_remote) it asks for a
    /// token
    #[arg(long, value_name = "HOST:PORT")]
    pub(crate) http: Option<String>,
    /// Number of threads that describe shapes; 0: one for each processor
    #[arg(long, value_name = "N")]
    pub(crate) workers: Option<usize>,
    /// Level of the log: error, warn, info, debug or trace
    #[arg(long, value_name = "LEVEL")]
    pub(crate) log_level: Option<String>,
}

/// The flag for the configuration file.
#[derive(Debug, Args)]
pub(crate) struct ConfigFile {
    /// Configuration file [default: /etc/coseg/coseg.toml if it exists]
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
}

/// The flag for the collection.
#[derive(Debug, Clone, Args)]
pub(crate) struct InCollection {
    /// The collection; optional if there is only one
    #[arg(long, short, value_name = "NAME")]
    pub(crate) collection: Option<String>,
}

/// The collection, for commands without another positional argument.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct OneCollection {
    /// The collection; optional if there is only one, or to select all
    #[arg(id = "COLLECTION", value_name = "COLLECTION")]
    name: Option<String>,
    /// The collection, as a flag
    #[arg(
        long = "collection",
        short,
        value_name = "NAME",
        conflicts_with = "COLLECTION"
    )]
    collection: Option<String>,
}

impl OneCollection {
    /// The named collection, however it was given.
    pub(crate) fn named(&self) -> Option<&String> {
        self.name.as_ref().or(self.collection.as_ref())
    }

    pub(crate) fn within(&self) -> InCollection {
        InCollection {
            collection: self.named().cloned(),
        }
    }
}

/// `coseg wait`
#[derive(Debug, Args)]
pub(crate) struct Wait {
    #[command(flatten)]
    pub(crate) of: OneCollection,
}

/// Settings of a collection. Omitted settings take their defaults, or stay unchanged.
#[derive(Debug, Clone, Args)]
pub(crate) struct Settings {
    /// Number of part kinds, 1 to 64; 0: estimated [default: estimated]
    #[arg(long, value_name = "N", value_parser = parts, allow_hyphen_values = true)]
    pub(crate) parts: Option<u32>,
    /// The axis that points up in every file: +x -x +y -y +z -z unknown auto [default: unknown]
    #[arg(long, value_name = "AXIS", value_parser = parse_up, allow_hyphen_values = true)]
    pub(crate) up: Option<wire::Up>,
    /// The Laplacian [default: tufted]
    #[arg(long, value_name = "OPERATOR")]
    pub(crate) operator: Option<Operator>,
    /// Number of faces of the working resolution [default: the daemon's]
    #[arg(long, value_name = "N")]
    pub(crate) working_faces: Option<u32>,
}

impl Settings {
    /// Converts to a collection's specification, in which omitted settings are not set.
    pub(crate) fn to_spec(&self, name: &str) -> wire::CollectionSpec {
        wire::CollectionSpec {
            name: name.to_owned(),
            n_parts: self.parts,
            up: self.up.unwrap_or(wire::Up::Unspecified).into(),
            operator: self
                .operator
                .map_or(wire::Operator::Unspecified, Operator::to_wire)
                .into(),
            working_faces: self.working_faces.unwrap_or(0),
        }
    }
}

/// Parses a number of part kinds, and checks the limits that are known without the daemon.
pub(crate) fn parts(text: &str) -> Result<u32, String> {
    let why = "the number of part kinds is 1 to 64; 0, or no --parts, lets it be estimated";
    match text.parse() {
        Ok(n) if n <= MAX_PARTS => Ok(n),
        _ => Err(why.to_owned()),
    }
}

/// A Laplacian.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum Operator {
    /// Intrinsic Delaunay on the tufted cover
    Tufted,
    /// Plain cotangents
    Cotan,
    /// Belkin, Sun and Wang 2008
    MeshLaplace,
}

impl Operator {
    /// The name on the command line.
    pub(crate) fn name(operator: operators::Operator) -> &'static str {
        match operator {
            operators::Operator::Tufted => "tufted",
            operators::Operator::Cotan => "cotan",
            operators::Operator::MeshLaplace => "mesh-laplace",
        }
    }

    pub(crate) fn to_domain(self) -> operators::Operator {
        match self {
            Self::Tufted => operators::Operator::Tufted,
            Self::Cotan => operators::Operator::Cotan,
            Self::MeshLaplace => operators::Operator::MeshLaplace,
        }
    }

    fn to_wire(self) -> wire::Operator {
        match self {
            Self::Tufted => wire::Operator::Tufted,
            Self::Cotan => wire::Operator::Cotan,
            Self::MeshLaplace => wire::Operator::MeshLaplace,
        }
    }
}

/// `coseg add`
#[derive(Debug, Args)]
pub(crate) struct Add {
    /// Mesh files (.obj, .off, .ply, .stl, .glb, .gltf), or folders of them; a shape takes the name
    /// of its file without the extension
    #[arg(required = true, value_name = "PATH")]
    pub(crate) paths: Vec<PathBuf>,
    /// Also add meshes in subfolders: a/b/1.obj below a named folder becomes the shape a__b__1
    #[arg(long, short)]
    pub(crate) recursive: bool,
    /// The collection, created if missing [default: the only one, or a new one named default]
    #[arg(long, short, value_name = "NAME")]
    pub(crate) collection: Option<String>,
    #[command(flatten)]
    pub(crate) settings: Settings,
    /// Replace shapes of the same name whose bytes differ
    #[arg(long)]
    pub(crate) replace: bool,
    /// Return once the shapes are accepted, before they are labelled
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg ls`
#[derive(Debug, Args)]
pub(crate) struct Ls {
    /// List the shapes of this collection
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Only shapes that have this label, an id or a name
    #[arg(long, value_name = "LABEL")]
    pub(crate) label: Option<String>,
    /// Only shapes with this verdict by a person
    #[arg(long, value_name = "STATE")]
    pub(crate) review: Option<Verdict>,
}

/// `coseg show`
#[derive(Debug, Args)]
pub(crate) struct Show {
    /// The shape [default: show the collection]
    pub(crate) shape: Option<String>,
    #[command(flatten)]
    pub(crate) within: InCollection,
}

/// `coseg labels`
#[derive(Debug, Args)]
pub(crate) struct Labels {
    /// The shape
    pub(crate) shape: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// An earlier version of the labels
    #[arg(long, value_name = "N")]
    pub(crate) version: Option<u64>,
    /// Print the probability of each label beside the label
    #[arg(long)]
    pub(crate) confidence: bool,
    /// Do not wait for queued shapes and relabellings
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg export`
#[derive(Debug, Args)]
pub(crate) struct Export {
    /// Shapes to export [default: all]
    pub(crate) shapes: Vec<String>,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// The format to write for each shape
    #[arg(long, value_name = "FORMAT")]
    pub(crate) format: ExportFormat,
    /// Folder for the files, created if missing
    #[arg(long, short, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Materials of parts, for glb, obj and ply of a glTF or an OBJ
    #[arg(long, value_name = "WHICH", default_value = "own")]
    pub(crate) materials: ExportMaterials,
    /// A subset for each part, such as leg_001, in place of one for each label, for usda
    #[arg(long)]
    pub(crate) instances: bool,
    /// Do not wait for queued shapes and relabellings
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// Which materials the parts of a file with materials have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ExportMaterials {
    /// The file's; faces without a material have that of their label
    Own,
    /// Those of the labels
    Labels,
}

/// The formats of `coseg export`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ExportFormat {
    /// NAME.labels.txt: a label for each face of the file, one on each line; -1: unlabelled
    Labels,
    /// NAME.ply: the mesh with a colour and an int label for each face and vertex
    Ply,
    /// NAME.obj and labels.mtl: the mesh with a group for each part, such as leg.001
    Obj,
    /// NAME.glb: the mesh with a node for each part, such as leg.001
    Glb,
    /// NAME.usda: the mesh with GeomSubsets, primvars and a material for each label
    Usda,
    /// NAME.labels.npy: an int32 for each face of the file
    Npy,
    /// NAME.labels.json: the labels and their names
    Json,
    /// NAME.seg: the same text as labels, under the name that Princeton's tools expect
    Seg,
}

/// `coseg nearest`
#[derive(Debug, Args)]
pub(crate) struct Nearest {
    /// The shape
    pub(crate) shape: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Maximum number of shapes
    #[arg(long, short = 'n', value_name = "N", default_value_t = 5)]
    pub(crate) limit: u32,
}

/// `coseg rm`
#[derive(Debug, Args)]
pub(crate) struct Rm {
    /// The shapes
    #[arg(required = true)]
    pub(crate) shapes: Vec<String>,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Do not ask for confirmation; without a terminal the command never asks
    #[arg(long, short)]
    pub(crate) yes: bool,
}

/// `coseg watch`
#[derive(Debug, Args)]
pub(crate) struct Watch {
    /// Only this collection
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Start after this sequence number [default: with the next event]
    #[arg(long, value_name = "SEQUENCE")]
    pub(crate) since: Option<u64>,
    /// Exit after this many events
    #[arg(long, short = 'n', value_name = "N")]
    pub(crate) limit: Option<u64>,
}

/// `coseg events`
#[derive(Debug, Args)]
pub(crate) struct Events {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Only events after this sequence number
    #[arg(long, value_name = "SEQUENCE", default_value_t = 0)]
    pub(crate) since: u64,
    /// Maximum number of events
    #[arg(long, short = 'n', value_name = "N")]
    pub(crate) limit: Option<u64>,
}

/// `coseg name`
#[derive(Debug, Args)]
pub(crate) struct Name {
    /// The label: its id, or its present name
    pub(crate) label: String,
    /// The new name
    pub(crate) name: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
}

/// `coseg collections`
#[derive(Debug, Subcommand)]
pub(crate) enum Collections {
    /// Create a collection
    Create {
        /// Its name
        name: String,
        #[command(flatten)]
        settings: Settings,
    },
    /// Change the up axis; shapes are labelled again along the new axis, and faces labelled by hand
    /// keep their labels
    Set {
        /// The collection
        name: String,
        /// The axis that points up in every file: +x -x +y -y +z -z unknown auto
        #[arg(long, value_name = "AXIS", value_parser = parse_up, allow_hyphen_values = true)]
        up: wire::Up,
        /// Return once the axis is set, before the shapes are labelled again
        #[arg(long)]
        no_wait: bool,
    },
    /// Delete a collection with its shapes and labels
    Delete {
        /// Its name
        name: String,
        /// Do not ask for confirmation; without a terminal the command never asks
        #[arg(long, short)]
        yes: bool,
    },
}

/// `coseg check`
#[derive(Debug, Args)]
pub(crate) struct Check {
    /// Folder of the library [default: shown by `coseg config show`]
    #[arg(long, value_name = "DIR")]
    pub(crate) library: Option<PathBuf>,
    /// Recompute damaged data where possible, and move the damaged files aside; not beside a
    /// running daemon
    #[arg(long)]
    pub(crate) repair: bool,
}

/// `coseg config`
#[derive(Debug, Subcommand)]
pub(crate) enum ConfigCommand {
    /// Check whether the daemon would start with this configuration
    Check(ConfigFile),
    /// Print the settings that the daemon would use
    Show(ConfigFile),
}

#[cfg(test)]
mod tests {
    use super::Cli;
    use clap::{CommandFactory as _, Parser as _};

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn global_flags_may_follow_the_subcommand() {
        let line = [
            "coseg",
            "ls",
            "--endpoint",
            "ipc:///x",
            "--json",
            "--timeout",
            "0.5",
        ];
        let cli = Cli::try_parse_from(line).unwrap();
        assert_eq!(cli.global.endpoint.as_deref(), Some("ipc:///x"));
        assert!(cli.global.json);
        assert_eq!(cli.global.timeout.as_millis(), 500);
    }

    #[test]
    fn axes_are_read_with_their_sign() {
        for axis in ["+y", "-z", "unknown", "auto"] {
            let line = ["coseg", "add", "x.off", "--up", axis];
            assert!(Cli::try_parse_from(line).is_ok(), "{axis}");
        }
        assert!(Cli::try_parse_from(["coseg", "add", "x.off", "--up", "w"]).is_err());
        assert!(Cli::try_parse_from(["coseg", "ls", "--timeout", "0"]).is_err());
    }

    #[test]
    fn a_number_of_parts_out_of_range_hears_the_range() {
        for parts in ["-1", "65", "4.5", "many", ""] {
            let line = ["coseg", "add", "x.off", "--parts", parts];
            let message = Cli::try_parse_from(line).unwrap_err().to_string();
            assert!(
                message.contains("1 to 64; 0, or no --parts"),
                "{parts}: {message}"
            );
        }
        assert!(Cli::try_parse_from(["coseg", "add", "x.off", "--parts", "64"]).is_ok());
    }

    #[test]
    fn one_collection_is_named_by_its_place_or_by_a_flag() {
        for command in [
            "ls", "wait", "events", "watch", "suggest", "ask", "undo", "jobs",
        ] {
            for line in [
                &["coseg", command, "chairs"][..],
                &["coseg", command, "--collection", "chairs"],
                &["coseg", command, "-c", "chairs"],
                &["coseg", command],
            ] {
                let parsed = Cli::try_parse_from(line);
                assert!(parsed.is_ok(), "{line:?}: {parsed:?}");
            }
            let both = ["coseg", command, "chairs", "-c", "chairs"];
            assert!(Cli::try_parse_from(both).is_err(), "{command}");
        }
    }
}
