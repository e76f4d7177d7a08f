//! `coseg ask` and `coseg answer`: the label of one part after the other.

use super::render::highlighted;
use super::session::Session;
use super::{CommandError, Outcome, export, json};
use crate::cli::{AnswerQuestion, Ask};
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire::{self, ErrorReason, answer_question_request::Answer};
use serde_json::json;
use std::io::{IsTerminal as _, Write as _, stdin};
use std::path::Path;

/// A question with the faces of its part.
struct Question {
    reply: wire::NextQuestionReply,
    faces: Vec<u32>,
}

/// What a person typed instead of an answer, or one.
#[derive(Debug, PartialEq)]
enum Typed {
    Answer(Answer),
    Undo,
    Quit,
    Unknown,
}

pub(crate) fn run(args: &Ask, mut session: Session) -> Outcome {
    let collection = session.collection(&args.of.within())?;
    if session.json || !stdin().is_terminal() {
        let question = next(&mut session, &collection, args.passed)?;
        draw(&mut session, &collection, &question, args.png.as_deref())?;
        print(&session, &question)?;
        return Ok(true);
    }
    eprintln!(
        "1 2 3: this label; a name: that label, which may be new; s: skip; w: cut wrongly; \
         u: undo; q: quit"
    );
    let by = args.person.name();
    loop {
        let question = match next(&mut session, &collection, args.passed) {
            Ok(question) => question,
            Err(CommandError::Client(ClientError::Refused(e)))
                if e.reason() == ErrorReason::NothingToAsk =>
            {
                eprintln!("nothing is left to ask");
                return Ok(true);
            }
            Err(e) => return Err(e),
        };
        draw(&mut session, &collection, &question, args.png.as_deref())?;
        print(&session, &question)?;
        let answer = loop {
            match typed(&line()?, &question.reply.likeliest) {
                Typed::Answer(answer) => break Some(answer),
                Typed::Undo => break None,
                Typed::Quit => return Ok(true),
                Typed::Unknown => eprintln!("there is no such choice"),
            }
        };
        match answer {
            Some(answer) => {
                let part = (question.reply.shape.as_str(), question.reply.part);
                send(&mut session, &collection, part, answer, &by)?;
            }
            None => {
                let request = wire::UndoRequest {
                    collection: collection.clone(),
                };
                let undone = call!(session.client, Undo(request))?;
                eprintln!("{} of {} undone", undone.change, undone.subject);
            }
        }
    }
}

pub(crate) fn answer(args: &AnswerQuestion, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let part = part(&args.part)?;
    let answer = match (&args.label, &args.new) {
        (Some(label), _) => Answer::Label(session.label(&collection, label)?),
        (None, Some(name)) => Answer::Named(name.clone()),
        (None, None) if args.skip => Answer::Skip(true),
        (None, None) => Answer::CutWrongly(true),
    };
    let by = args.person.name();
    let done = send(&mut session, &collection, part, answer, &by)?;
    if session.json {
        let corrected = done.corrected.unwrap_or_default();
        session.print_json(&json!({
            "shape": part.0,
            "part": part.1,
            "label": done.label,
            "version": corrected.version,
            "changed_share": corrected.changed_share,
            "n_shapes": corrected.n_stale,
            "job_id": corrected.job_id,
        }))?;
    }
    Ok(true)
}

/// A part as it is typed: a shape, a colon and a number.
pub(super) fn part(typed: &str) -> Result<(&str, u32), CommandError> {
    let parsed = typed.rsplit_once(':');
    let parsed = parsed.and_then(|(shape, part)| Some((shape, part.parse().ok()?)));
    parsed.ok_or_else(|| {
        CommandError::Usage(format!(
            "{typed:?} is not a part, which is written SHAPE:NUMBER, such as chair-001:3"
        ))
    })
}

fn next(session: &mut Session, collection: &str, passed: bool) -> Result<Question, CommandError> {
    let request = wire::NextQuestionRequest {
        collection: collection.to_owned(),
        passed,
    };
    let (reply, frames) = call!(session.client, NextQuestion(request), frames)?;
    let read = FrameReader::new(&frames).u32_array(reply.faces.as_ref(), "faces");
    let (faces, _) = read.map_err(|e| ClientError::BadReply(e.to_string()))?;
    Ok(Question { reply, faces })
}

fn send(
    session: &mut Session,
    collection: &str,
    (shape, part): (&str, u32),
    answer: Answer,
    by: &str,
) -> Result<wire::AnswerQuestionReply, CommandError> {
    let request = wire::AnswerQuestionRequest {
        collection: collection.to_owned(),
        shape: shape.to_owned(),
        part,
        answer: Some(answer),
        by: by.to_owned(),
    };
    Ok(call!(session.client, AnswerQuestion(request))?)
}

fn draw(
    session: &mut Session,
    collection: &str,
    question: &Question,
    png: Option<&Path>,
) -> Result<(), CommandError> {
    let Some(path) = png else { return Ok(()) };
    let mesh = export::Original::receive(session, collection, &question.reply.shape)?
        .any_mesh(&question.reply.shape)?;
    let up = session.describe(collection)?.spec.unwrap_or_default().up();
    let file = |source| CommandError::File {
        path: path.display().to_string(),
        source,
    };
    let picture = highlighted(&mesh, &question.faces, up).map_err(file)?;
    std::fs::write(path, picture).map_err(file)
}

fn print(session: &Session, question: &Question) -> Result<(), CommandError> {
    let q = &question.reply;
    if session.json {
        return session.print_json(&json::question(q, &question.faces));
    }
    let share = 100.0 * q.area_share;
    session.line(&format!("{}:{}  {share:.0} % of its area", q.shape, q.part))?;
    for (i, offered) in q.likeliest.iter().enumerate() {
        let (key, percent) = (i + 1, 100.0 * offered.probability);
        let name = label_text(offered);
        session.line(&format!("  {key}  {name}  {percent:.0} %"))?;
    }
    Ok(())
}

fn label_text(label: &wire::OfferedLabel) -> String {
    match label.name.as_str() {
        "" => format!("label {}", label.label),
        name => format!("{name} ({})", label.label),
    }
}

fn line() -> Result<String, CommandError> {
    let mut line = String::new();
    eprint!("> ");
    let read = std::io::stderr()
        .flush()
        .and_then(|()| stdin().read_line(&mut line));
    let n = read.map_err(|e| CommandError::Failed(format!("the answer cannot be read: {e}")))?;
    // The end of the input is the end of the session.
    Ok(if n == 0 { "q".to_owned() } else { line })
}

fn typed(line: &str, offered: &[wire::OfferedLabel]) -> Typed {
    match line.trim() {
        "" => Typed::Unknown,
        "q" => Typed::Quit,
        "u" => Typed::Undo,
        "s" => Typed::Answer(Answer::Skip(true)),
        "w" => Typed::Answer(Answer::CutWrongly(true)),
        text => match text.parse::<usize>() {
            Ok(key) => {
                let chosen = key.checked_sub(1).and_then(|i| offered.get(i));
                chosen.map_or(Typed::Unknown, |l| Typed::Answer(Answer::Label(l.label)))
            }
            Err(_) => Typed::Answer(Answer::Named(text.to_owned())),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::{Answer, Typed, part, typed};
    use coseg::ipc::wire::OfferedLabel;

    #[test]
    fn a_key_is_an_answer() {
        let offered = [7, 9].map(|label| OfferedLabel {
            label,
            ..OfferedLabel::default()
        });
        for (line, expected) in [
            ("1\n", Typed::Answer(Answer::Label(7))),
            (" 2 ", Typed::Answer(Answer::Label(9))),
            ("3", Typed::Unknown),
            ("0", Typed::Unknown),
            ("", Typed::Unknown),
            ("s", Typed::Answer(Answer::Skip(true))),
            ("w", Typed::Answer(Answer::CutWrongly(true))),
            ("u", Typed::Undo),
            ("q\n", Typed::Quit),
            (
                "seat back",
                Typed::Answer(Answer::Named("seat back".into())),
            ),
        ] {
            assert_eq!(typed(line, &offered), expected, "{line:?}");
        }
    }

    #[test]
    fn a_part_is_named_by_its_shape_and_number() {
        assert_eq!(part("a:b:3").unwrap(), ("a:b", 3));
        for wrong in ["a", "a:", "a:x", "a:-1"] {
            let message = part(wrong).unwrap_err().to_string();
            assert!(message.contains("SHAPE:NUMBER"), "{message}");
        }
    }
}
