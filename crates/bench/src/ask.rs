//! `coseg-bench ask`: measures accuracy after some answers of a person who answers by the truth,
//! and the time of an answer.

use crate::Global;
use crate::error::{BenchError, Outcome};
use crate::labels::mean;
use crate::print::{print_line, table};
use crate::session::{COLLECTION, Session, log_warnings};
use crate::stream::{self, Category};
use clap::Args;
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::convert::parse_up;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire::{self, ErrorReason, answer_question_request::Answer};
use coseg::labels::score::{ScoredShape, accuracy_by_id, pieces};
use coseg::mesh::FaceGeometry;
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Instant;

/// `coseg-bench ask`
#[derive(Debug, Clone, Args)]
pub(crate) struct BenchAsk {
    /// Folder with a folder of meshes for each category: NAME.off or .obj, and NAME.labels.txt with
    /// one integer a face
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Only these categories [default: all]
    #[arg(long, value_name = "NAME")]
    category: Vec<String>,
    /// Orders of arrival: the first is that of the names, others are shuffled
    #[arg(
        long,
        value_name = "N",
        default_value_t = 1,
        value_parser = clap::value_parser!(u32).range(1..=100)
    )]
    orders: u32,
    /// At most this many shapes of each category, the first by name
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    limit: Option<u32>,
    /// The axis that points up in every file [default: unknown]
    #[arg(long, value_name = "AXIS", value_parser = parse_up, allow_hyphen_values = true)]
    up: Option<wire::Up>,
    /// Numbers of answers after which the labels of all shapes are scored by id
    #[arg(
        long,
        value_name = "N,...",
        value_delimiter = ',',
        default_value = "5,10,20,40",
        value_parser = clap::value_parser!(u32).range(1..=10_000)
    )]
    answers: Vec<u32>,
}

/// What came of one order of arrival.
struct Run {
    /// For each number of answers.
    accuracies: Vec<f64>,
    /// From sending an answer until the next question is there.
    seconds: Vec<f64>,
    /// Share of the area of the answered parts that has another label than the answer.
    wrong_share: f64,
}

/// Seconds that a person takes to answer for a part, and to draw the boundaries of a whole shape
/// besides labelling its parts.
const ANSWER_SECONDS: f64 = 2.0;
const BOUNDARY_SECONDS: f64 = 20.0;

/// The runs of one category.
struct Row {
    name: String,
    runs: Vec<Run>,
    /// Seconds that a person takes to label a whole shape: the mean over the shapes.
    shape_seconds: f64,
}

impl Row {
    fn accuracy(&self, i: usize) -> f64 {
        mean(self.runs.iter().map(|r| r.accuracies[i]))
    }

    fn seconds(&self) -> f64 {
        mean(self.runs.iter().flat_map(|r| &r.seconds).copied())
    }

    fn wrong_share(&self) -> f64 {
        mean(self.runs.iter().map(|r| r.wrong_share))
    }
}

/// A part to answer for, with the faces that it has.
struct Question {
    shape: String,
    part: u32,
    faces: Vec<u32>,
}

pub(crate) fn run(args: &BenchAsk, global: &Global) -> Outcome {
    let categories = stream::categories(&args.data, &args.category, args.limit)?;
    log_warnings();
    let mut counts: Vec<usize> = args.answers.iter().map(|n| *n as usize).collect();
    counts.sort_unstable();
    counts.dedup();
    let mut rows = Vec::new();
    for category in &categories {
        let mut runs = Vec::new();
        for order in 0..args.orders {
            runs.push(play(category, order, &counts, args, global)?);
        }
        rows.push(Row {
            name: category.name.clone(),
            runs,
            shape_seconds: shape_seconds(category),
        });
    }
    if global.json {
        print_line(&report(&rows, &counts).to_string())?;
    } else {
        print_line(&table(&lines(&rows, &counts)))?;
    }
    Ok(true)
}

/// Streams a category through a daemon of its own, then answers its questions by the truth.
fn play(
    category: &Category,
    order: u32,
    counts: &[usize],
    args: &BenchAsk,
    global: &Global,
) -> Result<Run, BenchError> {
    let mut session = Session::start(global.patience())?;
    let up = args.up.unwrap_or(wire::Up::Unknown);
    let n_parts = category.n_parts as u32;
    stream::stream(category, order, n_parts, up, &mut session)?;
    let mut run = Run {
        accuracies: Vec::new(),
        seconds: Vec::new(),
        wrong_share: 0.0,
    };
    // Label id of each true label that was an answer.
    let mut ids = BTreeMap::<i32, u32>::new();
    let mut question = next(&mut session)?;
    let mut n_answered = 0;
    for &count in counts {
        while let Some(current) = question.take_if(|_| n_answered < count) {
            let (label, wrong) = truth(category, &current)?;
            run.wrong_share += wrong;
            let begin = Instant::now();
            let id = answer(&mut session, &current, label, ids.get(&label).copied())?;
            ids.insert(label, id);
            question = next(&mut session)?;
            run.seconds.push(begin.elapsed().as_secs_f64());
            n_answered += 1;
        }
        run.accuracies.push(accuracy(category, &ids, &mut session)?);
    }
    run.wrong_share /= f64::from(n_answered.max(1) as u32);
    session.drain();
    Ok(run)
}

/// Seconds that a person takes to label a whole shape of a category: an answer for each connected
/// part, and the time to draw boundaries. Mean over the shapes.
fn shape_seconds(category: &Category) -> f64 {
    let seconds = category.shapes.iter().map(|s| {
        let pieces: BTreeSet<usize> = pieces(&s.mesh.faces, &s.truth).into_iter().collect();
        ANSWER_SECONDS * f64::from(pieces.len() as u32) + BOUNDARY_SECONDS
    });
    mean(seconds)
}

fn next(session: &mut Session) -> Result<Option<Question>, BenchError> {
    let request = wire::NextQuestionRequest {
        collection: COLLECTION.to_owned(),
        passed: false,
    };
    let (reply, frames) = match call!(session.client, NextQuestion(request), frames) {
        Ok(found) => found,
        Err(ClientError::Refused(e)) if e.reason() == ErrorReason::NothingToAsk => return Ok(None),
        Err(e) => return Err(e.into()),
    };
    let read = FrameReader::new(&frames).u32_array(reply.faces.as_ref(), "faces");
    let (faces, _) = read.map_err(|e| ClientError::BadReply(e.to_string()))?;
    Ok(Some(Question {
        shape: reply.shape,
        part: reply.part,
        faces,
    }))
}

/// The true label of most of a part's area, and the share of it that has another one.
fn truth(category: &Category, question: &Question) -> Result<(i32, f64), BenchError> {
    let shape = category.shapes.iter().find(|s| s.name == question.shape);
    let shape = shape.ok_or_else(|| {
        BenchError::Failed(format!("{:?} was asked about and not sent", question.shape))
    })?;
    let areas = FaceGeometry::new(&shape.mesh).areas;
    let mut area = BTreeMap::<i32, f64>::new();
    for face in &question.faces {
        let face = *face as usize;
        *area.entry(shape.truth[face]).or_default() += areas[face];
    }
    let total: f64 = area.values().sum();
    let most = area
        .into_iter()
        .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
    let (label, most) = most.ok_or_else(|| {
        let (shape, part) = (&question.shape, question.part);
        BenchError::Failed(format!("part {part} of {shape:?} has no faces"))
    })?;
    Ok((label, 1.0 - most / total.max(1e-300)))
}

/// Answers with a label that was an answer before, or with a new one; returns its id.
fn answer(
    session: &mut Session,
    question: &Question,
    label: i32,
    id: Option<u32>,
) -> Result<u32, BenchError> {
    let request = wire::AnswerQuestionRequest {
        collection: COLLECTION.to_owned(),
        shape: question.shape.clone(),
        part: question.part,
        answer: Some(match id {
            Some(id) => Answer::Label(id),
            None => Answer::Named(format!("true {label}")),
        }),
        by: "bench".to_owned(),
    };
    let reply = call!(session.client, AnswerQuestion(request))?;
    let given = reply.label;
    given.ok_or_else(|| BenchError::Failed("an answer gave its part no label".to_owned()))
}

/// Accuracy of all shapes, once nothing is waiting. Labels that the person has named are compared
/// by their ids; a label that nobody has named is wrong.
fn accuracy(
    category: &Category,
    ids: &BTreeMap<i32, u32>,
    session: &mut Session,
) -> Result<f64, BenchError> {
    let true_label: BTreeMap<u32, i32> = ids.iter().map(|(label, id)| (*id, *label)).collect();
    let named = |id: i32| {
        let label = u32::try_from(id).ok().and_then(|id| true_label.get(&id));
        label.copied().unwrap_or(i32::MIN)
    };
    let found = stream::labels_now(category, session)?;
    let found: Vec<Option<Vec<i32>>> = found
        .into_iter()
        .map(|labels| labels.map(|l| l.into_iter().map(named).collect()))
        .collect();
    let shapes: Vec<ScoredShape<'_>> = category
        .shapes
        .iter()
        .zip(&found)
        .map(|(s, labels)| ScoredShape {
            mesh: &s.mesh,
            truth: &s.truth,
            predicted: labels.as_deref(),
        })
        .collect();
    let accuracy = accuracy_by_id(&shapes);
    accuracy.map_err(|e| BenchError::Failed(format!("{}: {e}", category.name)))
}

/// The table: a line for each category, the mean last.
fn lines(rows: &[Row], counts: &[usize]) -> Vec<Vec<String>> {
    let mut head = vec!["category".to_owned()];
    head.extend(counts.iter().map(|n| format!("{n} answers")));
    head.extend(["s an answer", "wrong share", "person's s a shape"].map(str::to_owned));
    let mut lines = vec![head];
    let line = |name: &str, of: &dyn Fn(usize) -> f64, [seconds, wrong, shape]: [f64; 3]| {
        let mut line = vec![name.to_owned()];
        line.extend((0..counts.len()).map(|i| format!("{:.3}", of(i))));
        line.extend([format!("{seconds:.2}"), format!("{wrong:.3}")]);
        line.push(format!("{shape:.0}"));
        line
    };
    for r in rows {
        lines.push(line(
            &r.name,
            &|i| r.accuracy(i),
            [r.seconds(), r.wrong_share(), r.shape_seconds],
        ));
    }
    let all = |i: usize| mean(rows.iter().map(|r| r.accuracy(i)));
    let seconds = mean(rows.iter().map(Row::seconds));
    let wrong = mean(rows.iter().map(Row::wrong_share));
    let shape = mean(rows.iter().map(|r| r.shape_seconds));
    lines.push(line("mean", &all, [seconds, wrong, shape]));
    lines
}

fn report(rows: &[Row], counts: &[usize]) -> Value {
    let by_count = |of: &dyn Fn(usize) -> f64| -> Value {
        let values = counts.iter().enumerate();
        let values: Map<String, Value> =
            values.map(|(i, n)| (n.to_string(), of(i).into())).collect();
        Value::Object(values)
    };
    let categories: Vec<Value> = rows
        .iter()
        .map(|r| {
            json!({
                "category": r.name,
                "accuracy": by_count(&|i| r.accuracy(i)),
                "seconds_per_answer": r.seconds(),
                "wrong_share": r.wrong_share(),
                "person_seconds_per_shape": r.shape_seconds,
                "orders": r.runs.iter().map(|run| &run.accuracies).collect::<Vec<_>>(),
            })
        })
        .collect();
    json!({
        "accuracy": by_count(&|i| mean(rows.iter().map(|r| r.accuracy(i)))),
        "person_seconds": by_count(&|i| ANSWER_SECONDS * f64::from(counts[i] as u32)),
        "categories": categories,
    })
}
