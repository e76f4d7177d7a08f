//! Links between parts over the command line and a real daemon.

use super::wait_idle;
use crate::harness::{Home, add, json, skittle, stdout};
use serde_json::Value;

fn labels(home: &Home, shape: &str) -> Vec<i64> {
    let text = stdout(&home.coseg(&["labels", shape]), 0);
    text.lines().map(|l| l.parse().unwrap()).collect()
}

/// Two parts of two shapes with one label.
fn pair(home: &Home) -> [String; 2] {
    let parts = |shape: &str| -> Vec<Value> {
        let shown = json(&home.coseg(&["show", shape, "--json"]), 0);
        shown["parts"].as_array().unwrap().clone()
    };
    let (a, b) = (parts("s0"), parts("s2"));
    let largest = |parts: &[Value]| {
        let area = |i: &usize| parts[*i]["area_share"].as_f64().unwrap();
        let most = (0..parts.len()).max_by(|x, y| area(x).total_cmp(&area(y)));
        most.unwrap()
    };
    let x = largest(&a);
    let y = (0..b.len())
        .find(|y| b[*y]["label"] == a[x]["label"])
        .unwrap();
    [format!("s0:{x}"), format!("s2:{y}")]
}

fn label_of(home: &Home, faces: &[usize], shape: &str) -> i64 {
    let labels = labels(home, shape);
    let mut found: Vec<i64> = faces.iter().map(|f| labels[*f]).collect();
    found.sort_unstable();
    let most = |l: &i64| found.iter().filter(|x| *x == l).count();
    *found.iter().max_by_key(|l| most(l)).unwrap()
}

#[test]
fn the_command_line_links_parts_lists_and_removes_links() {
    let home = Home::new();
    let daemon = home.start();
    let mut client = daemon.client();
    let texts: Vec<_> = (0..4).map(|i| (format!("s{i}"), skittle(i))).collect();
    let shapes: Vec<_> = texts
        .iter()
        .map(|(n, t)| (n.as_str(), t.as_str()))
        .collect();
    add(&mut client, "c", &shapes);
    wait_idle(&mut client, "c");
    let before: Vec<Vec<i64>> = (0..4).map(|i| labels(&home, &format!("s{i}"))).collect();
    let [a, b] = pair(&home);
    // Faces with the label of the linked parts, of which each shape has one part here or several.
    let shown = json(&home.coseg(&["show", "s0", "--json"]), 0);
    let at: usize = a.rsplit(':').next().unwrap().parse().unwrap();
    let label = shown["parts"][at]["label"].as_i64().unwrap();
    let faces = [0, 2].map(|s| -> Vec<usize> {
        let labels = before[s].iter().enumerate();
        labels.filter(|l| *l.1 == label).map(|l| l.0).collect()
    });

    let made = json(&home.coseg(&["differ", &a, &b, "--by", "ada", "--json"]), 0);
    assert_eq!(
        (&made["changed"], &made["link"]["kind"]),
        (&true.into(), &"differ".into())
    );
    assert_eq!(made["link"]["holds"], true);
    assert_ne!(
        label_of(&home, &faces[0], "s0"),
        label_of(&home, &faces[1], "s2")
    );
    let id = made["link"]["id"].to_string();
    let list = json(&home.coseg(&["links", "c", "--json"]), 0);
    assert_eq!(list["links"][0], made["link"]);
    let text = stdout(&home.coseg(&["links", "c", "--shape", "s0"]), 0);
    assert!(
        text.contains("differ") && text.contains("ada") && text.contains("holds"),
        "{text}"
    );
    assert!(!stdout(&home.coseg(&["links", "--shape", "s1"]), 0).contains("differ"));
    let text = stdout(&home.coseg(&["show", "s2"]), 0);
    let shown = format!("link {id}: {a} has another label than {b} (holds)");
    assert!(text.contains(&shown), "{text}");
    let events = stdout(&home.coseg(&["events", "c"]), 0);
    let line = format!("link {id}: {a} has another label than {b}");
    assert!(events.contains(&line), "{events}");

    // Everything survives a restart.
    let labelled: Vec<Vec<i64>> = (0..4).map(|i| labels(&home, &format!("s{i}"))).collect();
    drop(client);
    drop(daemon);
    let _daemon = home.start();
    assert_eq!(json(&home.coseg(&["links", "c", "--json"]), 0), list);
    let again: Vec<Vec<i64>> = (0..4).map(|i| labels(&home, &format!("s{i}"))).collect();
    assert_eq!(again, labelled);

    // Undoing the removal and the link itself.
    stdout(&home.coseg(&["unlink", &id]), 0);
    assert_eq!(
        json(&home.coseg(&["links", "c", "--json"]), 0)["links"],
        Value::Array(vec![])
    );
    let undone = json(&home.coseg(&["undo", "--json"]), 0);
    assert_eq!(undone["undone"], "unlink");
    assert_eq!(json(&home.coseg(&["links", "c", "--json"]), 0), list);
    let undone = json(&home.coseg(&["undo", "--json"]), 0);
    assert_eq!(undone["undone"], "differ");
    assert_eq!(undone["subject"], format!("{a} {b}"));
    let restored: Vec<Vec<i64>> = (0..4).map(|i| labels(&home, &format!("s{i}"))).collect();
    assert_eq!(restored, before);

    // A contradiction is refused, and says what contradicts; parts are written SHAPE:NUMBER.
    let same = stdout(&home.coseg(&["same", &a, &b]), 0);
    let refused = home.coseg(&["differ", &a, &b]);
    assert_eq!(refused.status.code(), Some(1));
    let message = String::from_utf8_lossy(&refused.stderr).into_owned();
    let chain = format!("{a} has the label of {b} (link {})", same.trim());
    assert!(
        message.contains(&chain) && message.contains("coseg unlink"),
        "{message}"
    );
    assert_eq!(home.coseg(&["same", "s0", &b]).status.code(), Some(2));
    let gone = home.coseg(&["unlink", "999"]);
    assert_eq!(gone.status.code(), Some(1));
}
