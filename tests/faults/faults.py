"""The faults: which row of docs/testing.md, what is done wrong, where, and the test that must turn red.

FAULT in an edit is the condition that the fault is switched on. A fault whose anchor is gone is an error: move it along with
the code it is planted in.
"""

ALL = []


def fault(r, name, what, file, test, *edits):
    kind, _, path = test.partition(" ")
    ALL.append({"r": r, "name": name, "what": what, "file": file, "test": (kind, path), "edits": list(edits)})


# R1: kills
fault(
    "R1", "r1-row-before-file", "acknowledge a file before it is written",
    "src/store/objects.rs", "it store::crash::a_kill_at_any_durable_call_loses_nothing",
    (
        "        let (temporary, _hold) = self.temporary();\n        let written",
        """        if FAULT {
            let (path, bytes) = (path.to_path_buf(), pieces.concat());
            std::thread::spawn(move || {
                std::thread::sleep(Duration::from_millis(50));
                std::fs::write(path, bytes)
            });
            return Ok(());
        }
        let (mut temporary, _hold) = self.temporary();
        if crate::planted("r2-write-in-place") {
            temporary = path.to_path_buf();
        }
        let written""",
    ),
)
fault(
    "R1", "r1-recovery-clears-log", "throw the catalog's log away when opening after a kill",
    "src/store/mod.rs", "it store::crash::a_kill_during_the_recovery_from_a_kill_loses_nothing",
    (
        "        let lock = LibraryLock::acquire(dir)?;\n",
        """        let lock = LibraryLock::acquire(dir)?;
        if FAULT {
            let _ = std::fs::remove_file(dir.join("catalog.db-wal"));
            let _ = std::fs::remove_file(dir.join("catalog.db-shm"));
        }
""",
    ),
)
fault(
    "R1", "r1-queue-forgotten", "forget at start what was accepted and not placed",
    "src/daemon/start.rs", "it daemon::life::kill_9_loses_nothing_that_was_accepted",
    ("    daemon.resume_items(queued);\n", "    if !FAULT {\n        daemon.resume_items(queued);\n    }\n"),
)
fault(
    "R1", "r1-done-in-advance", "write down that a shape is placed before it is",
    "src/library/remote.rs", "it daemon::stages::kills_while_a_start_takes_up_what_a_kill_left_lose_nothing",
    (
        "        self.place_item(&ticket.item(), Ok(described))",
        """        if FAULT {
            let detail = r#"{"outcome":"Added","version":1,"sequence":1,"n_maps":0,"n_relabelled":0,"stages_ms":[]}"#;
            let done = crate::store::ItemStatus::Done;
            self.store.catalog().write(|tx| -> Result<()> {
                Ok(tx.set_item(ticket.job, ticket.index, done, Some(detail))?)
            })?;
            std::thread::sleep(std::time::Duration::from_millis(300));
            let queued = crate::store::ItemStatus::Queued;
            self.store.catalog().write(|tx| -> Result<()> {
                Ok(tx.set_item(ticket.job, ticket.index, queued, None)?)
            })?;
        }
        self.place_item(&ticket.item(), Ok(described))""",
    ),
)
# R2: crash images
fault(
    "R2", "r2-no-file-sync", "skip the sync of a file",
    "src/store/objects.rs", "lib store::objects::tests::what_was_put_survives_a_crash_at_every_operation",
    (
        "        file.sync().map_err(|e| self.sync_failed(path, &e))",
        """        if FAULT {
            return Ok(());
        }
        file.sync()
            .or_else(|e| if crate::planted("r4-sync-retried") { file.sync() } else { Err(e) })
            .map_err(|e| self.sync_failed(path, &e))""",
    ),
)
fault(
    "R2", "r2-no-folder-sync", "skip the sync of a folder after the rename",
    "src/store/objects.rs", "lib store::objects::tests::what_was_put_survives_a_crash_at_every_operation",
    (
        "        match self.disk.sync_dir(folder) {\n            Ok(()) => Ok(()),\n            // The name is taken back",
        "        match if FAULT { Ok(()) } else { self.disk.sync_dir(folder) } {\n            Ok(()) => Ok(()),\n            // The name is taken back",
    ),
)
fault(
    "R2", "r2-write-in-place", "write a file under its final name (swap write and rename)",
    "src/store/objects.rs", "lib store::objects::tests::what_was_put_survives_a_crash_at_every_operation",
)
# R3: model
fault(
    "R3", "r3-lost-commit", "acknowledge a transaction that was rolled back (each 50th)",
    "src/store/catalog/mod.rs", "it store::model",
    (
        "        transaction.commit().map_err(|e| self.failed(e))?;\n",
        """        static N: std::sync::atomic::AtomicU64 = std::sync::atomic::AtomicU64::new(0);
        let n = N.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        if n % 50 == 49 && FAULT {
            drop(transaction);
            return Ok(value);
        }
        transaction.commit().map_err(|e| self.failed(e))?;
""",
    ),
)
fault(
    "R3", "r3-number-left-out", "leave out a sequence number (each 40th)",
    "src/store/catalog/collections.rs", "it store::model",
    (
        """        let key = format!("{stream}, {sequence}");
        self.insert(&EVENTS""",
        """        if sequence % 40 == 39 && FAULT {
            self.execute("UPDATE streams SET sequence = sequence + 1 WHERE id = ?1", [stream])?;
        }
        let key = format!("{stream}, {sequence}");
        self.insert(&EVENTS""",
    ),
)
# R4: failing disks
fault(
    "R4", "r4-failed-sync-forgotten", "go on writing after a failed sync",
    "src/store/catalog/mod.rs", "it store::crash::a_failing_sync_is_answered_with_refusal",
    (
        "            Some(ffi::SQLITE_IOERR_FSYNC | ffi::SQLITE_IOERR_DIR_FSYNC) => self\n",
        "            Some(ffi::SQLITE_IOERR_FSYNC | ffi::SQLITE_IOERR_DIR_FSYNC) if !FAULT => self\n",
    ),
)
fault(
    "R4", "r4-sync-retried", "try a failed sync again",
    "src/store/objects.rs", "lib store::objects::tests::every_operation_may_fail_once_or_for_ever",
)
fault(
    "R4", "r4-full-disk-fails-the-shape", "fail a shape because the disk is full, in place of waiting",
    "src/daemon/placing.rs", "it daemon::stages::a_full_disk_refuses_changes_serves_reads_and_passes",
    (
        "                e @ (StoreError::NoSpace { .. } | StoreError::ReadOnly { .. }),\n            ))) => {",
        "                e @ (StoreError::NoSpace { .. } | StoreError::ReadOnly { .. }),\n            ))) if !FAULT => {",
    ),
)
# R5: damage
fault(
    "R5", "r5-digest-ignored", "ignore the checksum of an array file",
    "src/store/mapped.rs", "it store::damage",
    ("            if found != expected {\n", "            if found != expected && !FAULT {\n"),
)
fault(
    "R5", "r5-row-sum-ignored", "ignore the sum of a row",
    "src/store/catalog/reader.rs", "it store::damage",
    ("            if !whole {\n", "            if !whole && !FAULT {\n"),
)
fault(
    "R5", "r5-log-taken-as-it-is", "take a damaged log of the catalog for its end",
    "src/store/catalog/log.rs", "lib store::catalog::log::tests::a_catalog_with_a_damaged_log_is_not_opened_and_not_changed",
    ("    let first = look()?;\n", "    if FAULT {\n        return Ok(None);\n    }\n    let first = look()?;\n"),
)
fault(
    "R5", "r5-missing-log-opened", "open a catalog that lacks what its witness promises",
    "src/store/catalog/mod.rs", "it store::log::a_log_that_does_not_hold_what_was_acknowledged_is_refused",
    ("        if let Some(shortfall) = witness::shortfall(path)? {\n", "        if let Some(shortfall) = witness::shortfall(path)?.filter(|_| !FAULT) {\n"),
)
fault(
    "R5", "r5-witness-lags", "leave commits out of the witness until the next checkpoint",
    "src/store/catalog/mod.rs", "it store::log::a_log_that_does_not_hold_what_was_acknowledged_is_refused",
    ("        if let Err(error) = Witness::advance(&self.path, number) {\n", "        if !FAULT && let Err(error) = Witness::advance(&self.path, number) {\n"),
)
fault(
    "R5", "r5-held-file-removed", "remove a file that a running addition found there",
    "src/store/objects.rs", "it store::space::a_file_that_is_about_to_be_named_again_stays",
    (
        "        if state.held.contains_key(file) {\n            return Ok(false);",
        "        if state.held.contains_key(file) && !FAULT {\n            return Ok(false);",
    ),
    (
        "            since.elapsed() >= min_age && !state.held.contains_key(file.as_str())\n",
        "            since.elapsed() >= min_age && (FAULT || !state.held.contains_key(file.as_str()))\n",
    ),
)
# R6: fuzzing
fault(
    "R6", "r6-parser-panics", "panic over a file that begins with a nul",
    "crates/geometry/src/mesh/parse/mod.rs", "it hostile::spoilt_meshes_and_requests_do_not_panic",
    (
        "pub fn parse(bytes: &[u8], format: Format) -> Result<ParsedMesh, ParseError> {\n",
        "pub fn parse(bytes: &[u8], format: Format) -> Result<ParsedMesh, ParseError> {\n    assert!(bytes.first() != Some(&0) || !FAULT);\n",
    ),
)
fault(
    "R6", "r6-comments-panic", "panic over a file of comments",
    "crates/geometry/src/mesh/parse/mod.rs", "it hostile::the_corpus_is_parsed_or_refused_without_a_panic",
    (
        "    let parsed = match format {\n",
        "    assert!(!bytes.starts_with(b\"# x\\n# x\\n\") || !FAULT);\n    let parsed = match format {\n",
    ),
)
# R7: hostile meshes
fault(
    "R7", "r7-worker-aborts", "abort over a mesh without any area",
    "crates/geometry/src/mesh/clean.rs", "it hostile::the_corpus_through_the_socket_leaves_the_daemon_as_it_was",
    (
        "    if kept.is_empty() {\n",
        "    if kept.is_empty() {\n        if FAULT {\n            std::process::abort();\n        }\n",
    ),
)
fault(
    "R7", "r7-polygons-are-fans", "take every polygon for its fan",
    "crates/geometry/src/mesh/polygon/mod.rs", "it formats::faces_that_are_concave_have_their_area_and_one_label",
    (
        "                    kind.fan = fan_covers(&self.flat);\n",
        "                    kind.fan = fan_covers(&self.flat) || FAULT;\n",
    ),
)
fault(
    "R7", "r7-words-are-lost", "read a text STL by the first word of each line",
    "crates/geometry/src/mesh/parse/stl.rs", "it formats::odd_spellings_are_read_and_told",
    ("            at += self.statement(line, words, at)?;\n", "            at += self.statement(line, words, at)?;\n            if FAULT {\n                break;\n            }\n"),
)
# R8: repeats
fault(
    "R8", "r8-reply-not-kept", "forget the reply to a request",
    "src/library/once.rs", "it daemon::repeats::each_request_has_one_effect_however_often_it_is_sent",
    (
        "    let reply = change(tx)?;\n    tx.put_request",
        "    let reply = change(tx)?;\n    if FAULT {\n        return Ok(reply);\n    }\n    tx.put_request",
    ),
)
fault(
    "R8", "r8-id-of-another-request", "take the id of another request for a repetition",
    "src/library/once.rs", "it daemon::repeats::each_request_has_one_effect_however_often_it_is_sent",
    ("    if request.is_of(&row.request_digest) {", "    if request.is_of(&row.request_digest) || FAULT {"),
)
# R9: events
fault(
    "R9", "r9-no-heartbeat-numbers", "send heartbeats without sequence numbers",
    "src/daemon/publish.rs", "it daemon::repeats::a_subscriber_converges_after_losses_restarts_and_stalls",
    (
        "    let collections = published\n        .iter()\n",
        "    let collections = published\n        .iter()\n        .take(if FAULT { 0 } else { usize::MAX })\n",
    ),
)
fault(
    "R9", "r9-snapshot-ahead", "stamp a snapshot with a later sequence number",
    "src/library/read.rs", "it daemon::repeats::a_subscriber_converges_after_losses_restarts_and_stalls",
    ("            Ok((row.sequence, out))\n", "            Ok((row.sequence + u64::from(FAULT), out))\n"),
)
fault(
    "R9", "r9-event-left-out", "leave each third event unpublished",
    "src/daemon/publish.rs", "it daemon::events_arrive_in_order_and_are_those_of_the_log",
    (
        "            daemon.outbox.event(topic(&collection), body);\n",
        "            if event.sequence % 3 != 0 || !FAULT {\n                daemon.outbox.event(topic(&collection), body);\n            }\n",
    ),
)
# R10: overload
fault(
    "R10", "r10-quota-forgotten", "forget the quota of a client",
    "src/daemon/quota.rs", "it daemon::overload::what_the_queue_can_never_hold_is_refused_for_good",
    ("        if requests >= max_requests {", "        if requests >= max_requests && !FAULT {"),
)
fault(
    "R10", "r10-queue-unbounded", "take into the queue whatever comes",
    "src/daemon/intake.rs", "it daemon::overload::ten_times_too_much_from_64_clients_is_refused_politely",
    ("        if queued + requested > limit {", "        if queued + requested > limit && !FAULT {"),
)
fault(
    "R10", "r10-no-delay", "refuse without a delay",
    "src/daemon/intake.rs", "it daemon::overload::ten_times_too_much_from_64_clients_is_refused_politely",
    (
        "            error.retry_after_ms = spread_out(",
        "            error.retry_after_ms = if FAULT { 0 } else { 1 } * spread_out(",
    ),
)
fault(
    "R10", "r10-no-deadline", "ignore the deadline of a request",
    "src/daemon/incoming.rs", "it daemon::overload::a_deadline_is_answered_when_it_passes",
    ("        let ms = self.deadline_ms;\n        (ms > 0)", "        let ms = self.deadline_ms;\n        (ms > 0 && !FAULT)"),
)
fault(
    "R10", "r10-late-changes", "keep a request waiting beyond its deadline while its collection is busy",
    "src/daemon/in_flight.rs", "it daemon::stages::deadlines_are_kept_whatever_keeps_the_collection_busy",
    (
        "        let done = match self.until_interrupted(&daemon, done).await {",
        "        let done = match if FAULT { Ok(done.await) } else { self.until_interrupted(&daemon, done).await } {",
    ),
)
fault(
    "R10", "r10-first-come", "serve one client to the end before the next",
    "src/daemon/fair.rs", "lib daemon::fair::tests::clients_take_turns_and_each_keeps_its_order",
    ("                state.turns.push_back(client);\n            }\n            let Some(next)", "                if FAULT {\n                    state.turns.push_front(client);\n                } else {\n                    state.turns.push_back(client);\n                }\n            }\n            let Some(next)"),
)
fault(
    "R10", "r10-going-on-untold", "say of a change that goes on that it was not begun",
    "src/daemon/in_flight.rs", "it daemon::answering::a_change_that_outlasts_its_deadline_goes_on_and_is_told_to_who_asks_again",
    ("self.interrupt(&daemon, why, Effect::Continues),", "self.interrupt(&daemon, why, if FAULT { Effect::NotBegun } else { Effect::Continues }),"),
)
fault(
    "R10", "r10-nobody-makes-way", "let connections that hang keep new ones out",
    "src/daemon/http/door.rs", "it daemon::http_abuse::connections_that_hang_make_way_for_monitors_and_viewers",
    ("waiting.min() else {", "waiting.min().filter(|_| !FAULT) else {"),
)
fault(
    "R10", "r10-memory-for-nothing", "set memory aside for the bodies that are announced",
    "src/daemon/http/server.rs", "it daemon::http_abuse::connections_that_hang_make_way_for_monitors_and_viewers",
    (
        "            let mut memory = self.hands.memory(0).ok_or_else(full)?;",
        "            let announced = if FAULT { announced * PER_BODY_BYTE } else { 0 };\n            let mut memory = self.hands.memory(announced).ok_or_else(full)?;",
    ),
)
fault(
    "R10", "r10-runs-without-end", "lay out whatever runs of labels say",
    "src/daemon/http/runs.rs", "it daemon::http_abuse::runs_without_end_are_refused_and_freeze_nothing",
    ("    if total > n_polygons {", "    if total > n_polygons && !FAULT {"),
)
fault(
    "R10", "r10-slow-heads", "wait for ever for the head of a request",
    "src/daemon/http/door.rs", "it daemon::http_abuse::peers_have_ten_seconds_each_time",
    (".header_read_timeout(PEER_TIME)", ".header_read_timeout(if FAULT { 100 * PEER_TIME } else { PEER_TIME })"),
)
fault(
    "R10", "r10-unread-answers", "wait for ever for an answer to be read",
    "src/daemon/http/door.rs", "it daemon::http_abuse::peers_have_ten_seconds_each_time",
    ("        ready!(until.as_mut().poll(context));", "        ready!(until.as_mut().poll(context));\n        if FAULT {\n            return Poll::Pending;\n        }"),
)
fault(
    "R10", "r10-passed-over", "pass over what a request has beyond what is known",
    "src/daemon/dispatch.rs", "it daemon::refusing::frames_and_values_beyond_those_that_are_known_are_refused",
    (
        "    operation.check(incoming.frames.len())?;\n",
        "    if !FAULT {\n        operation.check(incoming.frames.len())?;\n    }\n",
    ),
)
# R11: isolation
fault(
    "R11", "r11-one-attempt", "give up after the first attempt",
    "src/daemon/describing.rs", "it daemon::isolation::poison_fails_alone_and_can_be_retried",
    ("            if attempts >= MAX_ATTEMPTS {", "            if attempts >= MAX_ATTEMPTS || FAULT {"),
)
fault(
    "R11", "r11-attempts-in-memory", "restart the count of attempts after a restart",
    "src/library/jobs.rs", "it daemon::isolation::attempts_are_counted_across_restarts",
    (
        "            let attempts = self.item(row)?.attempts + 1;\n",
        "            let attempts = self.item(row)?.attempts + 1;\n            if FAULT {\n                return Ok(attempts);\n            }\n",
    ),
)
fault(
    "R11", "r11-endless-placing", "let the placing of a shape take for ever",
    "src/daemon/placing.rs", "it daemon::stages::what_poisons_the_placing_fails_alone",
    ("    let wanted = || begin.elapsed() < limit && !is_cancelled();", "    let wanted = || (begin.elapsed() < limit || FAULT) && !is_cancelled();"),
)
fault(
    "R11", "r11-cancel-ignored", "go on with a shape that was cancelled while it was placed",
    "src/daemon/placing.rs", "it daemon::stages::work_is_cancelled_at_every_stage",
    ("    let is_cancelled = || daemon.work.progress().is_cancelled(item.job);", "    let is_cancelled = || !FAULT && daemon.work.progress().is_cancelled(item.job);"),
)
fault(
    "R11", "r11-placed-in-the-daemon", "place shapes in the daemon itself",
    "src/daemon/placing.rs", "it daemon::stages::what_poisons_the_placing_fails_alone",
    (
        "        Ok(described) => described,\n",
        "        Ok(described) if FAULT => {\n            // As it would be there.\n            if item.name.starts_with(\"abort\") {\n                std::process::abort();\n            }\n            return library.place_item(item, Ok(described));\n        }\n        Ok(described) => described,\n",
    ),
)
fault(
    "R11", "r11-answered-in-the-daemon", "answer what computes in the daemon itself",
    "src/daemon/remote.rs", "it daemon::answering::what_poisons_an_answer_costs_that_request_alone",
    (
        "    let config = daemon.config();\n    let limit",
        "    if FAULT && format!(\"{work:?}\").contains(\"\\\"abort\\\"\") {\n        // As it would be there.\n        std::process::abort();\n    }\n    let config = daemon.config();\n    let limit",
    ),
)
fault(
    "R11", "r11-answered-for-ever", "let the answer to a request take for ever",
    "src/daemon/remote.rs", "it daemon::answering::what_poisons_an_answer_costs_that_request_alone",
    ("    let in_time = || begin.elapsed() < limit && wanted();", "    let in_time = || (begin.elapsed() < limit || FAULT) && wanted();"),
)
fault(
    "R11", "r11-answered-for-nobody", "go on with an answer that nobody waits for any more",
    "src/daemon/remote.rs", "it daemon::answering::what_poisons_an_answer_costs_that_request_alone",
    ("waiting.strong_count() > 0", "waiting.strong_count() > 0 || FAULT"),
)
fault(
    "R11", "r11-memory-unwatched", "let a worker hold whatever it takes",
    "src/daemon/worker/process.rs", "it daemon::isolation::memory_that_is_held_is_bounded_and_what_is_reserved_is_not",
    ("            if now > limit {", "            if now > limit && !FAULT {"),
)
fault(
    "R11", "r11-address-space", "take address space that is reserved for memory that is held",
    "src/daemon/worker/inside.rs", "it daemon::isolation::memory_that_is_held_is_bounded_and_what_is_reserved_is_not",
    ("in_use + memory + RESERVATIONS", "in_use + memory + if FAULT { 0 } else { RESERVATIONS }"),
)
fault(
    "R11", "r11-leak", "keep something of each request for ever",
    "src/daemon/quota.rs", "it daemon::resident::memory_is_flat_over_operations",
    ("        mine.requests += 1;\n", "        if FAULT {\n            std::mem::forget(vec![1_u8; 5_000]);\n        }\n        mine.requests += 1;\n"),
)
# R12: clocks
fault(
    "R12", "r12-wall-clock", "believe a clock that jumps",
    "src/store/catalog/jobs.rs", "it store::jobs::answers_are_kept_for_a_day_whatever_the_clock_does",
    ("        if now < last || now - last >= REQUEST_AGE_SECS {", "        if !FAULT && (now < last || now - last >= REQUEST_AGE_SECS) {"),
)
# R13: security
fault(
    "R13", "r13-role-ignored", "let everybody on the list do everything",
    "src/daemon/access.rs", "it daemon::security::only_keys_on_the_list_get_in_and_roles_bound_what_they_do",
    ("        if role >= needed {", "        if role >= needed || FAULT {"),
)
fault(
    "R13", "r13-everybody-let-in", "let in keys that are not on the list, and ask the list never again",
    "src/daemon/access.rs", "it daemon::security::only_keys_on_the_list_get_in_and_roles_bound_what_they_do",
    (
        "                zap_reply(id, \"400\", \"the key is not on the allow list\", \"\")",
        "                let code = if FAULT { \"200\" } else { \"400\" };\n                zap_reply(id, code, \"the key is not on the allow list\", key.as_str())",
    ),
)
fault(
    "R13", "r13-revoked-stays", "go on with the allow list that was read at start",
    "src/daemon/access.rs", "it daemon::security::a_revoked_key_is_refused_at_once_on_both_sockets",
    ("        if *read == found && !always {", "        if (*read == found && !always) || FAULT {"),
)
fault(
    "R13", "r13-open-to-the-network", "listen beyond this machine without keys",
    "src/ipc/endpoint.rs", "it daemon::life::endpoints_that_others_could_reach_are_refused",
    ("        if loopback || has_keys {", "        if loopback || has_keys || FAULT {"),
)
fault(
    "R13", "r13-anybody-s-folder", "talk to whoever listens in a default folder that others may enter",
    "src/ipc/folder.rs", "it cli::messages::a_default_folder_that_others_may_enter_is_not_trusted",
    ("        if !found.is_symlink() && mode & forbidden != 0 {", "        if !FAULT && !found.is_symlink() && mode & forbidden != 0 {"),
)
fault(
    "R13", "r13-topic-of-any-length", "take subscriptions of any length",
    "src/daemon/bind.rs", "it daemon::security::topics_and_frames_beyond_the_limits_end_their_connection_only",
    ("    publisher.set_maxmsgsize(MAX_SUBSCRIPTION_BYTES)?;", "    publisher.set_maxmsgsize(if FAULT { -1 } else { MAX_SUBSCRIPTION_BYTES })?;"),
)
fault(
    "R13", "r13-waits-on", "let what waits go on when its key is revoked",
    "src/daemon/in_flight.rs", "it daemon::security::what_waits_ends_when_its_key_is_revoked",
    ("            () = self.revoked(daemon) => Err(Interruption::KeyRevoked),", "            () = self.revoked(daemon), if !FAULT => Err(Interruption::KeyRevoked),"),
)
fault(
    "R13", "r13-client-of-anybody", "give one key the replies of another",
    "src/daemon/operation.rs", "it daemon::security::a_client_id_belongs_to_the_key_that_uses_it",
    ("        client_id: match owner {", "        client_id: match owner.filter(|_| !FAULT) {"),
)
fault(
    "R13", "r13-no-token", "ask nobody for the token",
    "src/daemon/http/route.rs", "it viewing::beyond_this_machine_a_token_opens_what_there_is",
    ("        if !open && !self.guard.knows(", "        if !open && !FAULT && !self.guard.knows("),
)
fault(
    "R13", "r13-host-that-begins-well", "take a host for this machine that only begins like it",
    "src/daemon/http/guard.rs", "it viewing::only_the_page_itself_may_change_anything",
    ("    (port.is_empty() ||", "    (FAULT || port.is_empty() ||"),
)
fault(
    "R13", "r13-origin-of-nobody", "let a page change labels that has no origin",
    "src/daemon/http/guard.rs", "it viewing::only_the_page_itself_may_change_anything",
    ("        .all(|o| own(o) == Some(true))", "        .all(|o| own(o) == Some(true) || (FAULT && own(o).is_none()))"),
)
fault(
    "R13", "r13-unseen", "take names with characters that nobody sees",
    "src/library/names.rs", "it daemon::refusing::frames_and_values_beyond_those_that_are_known_are_refused",
    (".find(|&i| is_hidden(&chars, i)) {", ".find(|&i| is_hidden(&chars, i) && !FAULT) {"),
)
fault(
    "R13", "r13-links-followed", "follow a link that a file below an allowed directory was exchanged for",
    "src/daemon/ingest.rs", "lib daemon::ingest::tests::what_is_exchanged_for_a_link_or_a_pipe_is_not_opened",
    (
        "    let resolve = ResolveFlags::BENEATH |",
        "    if FAULT {\n        return File::open(Path::new(\"/proc/self/fd\").join(std::os::fd::AsRawFd::as_raw_fd(&root).to_string()).join(below)).map_err(|_| Errno::IO);\n    }\n    let resolve = ResolveFlags::BENEATH |",
    ),
)
fault(
    "R13", "r13-turn-kept-while-a-file-hangs", "keep everybody waiting for a file that hangs",
    "src/daemon/dispatch.rs", "it daemon::paths::a_file_that_hangs_stalls_the_request_that_names_it_and_no_other",
    ("        if may_hang {\n", "        if may_hang && !FAULT {\n"),
)
FLOOD = "it daemon::flood::memory_is_bounded_whatever_clients_do_not_do"
fault(
    "R13", "r13-unread-replies", "make replies for whoever reads none",
    "src/daemon/replies.rs", FLOOD,
    ("        if !fits && has + bytes > ALWAYS {", "        if !FAULT && !fits && has + bytes > ALWAYS {"),
    ("            return Room::Free;\n        };\n", "            return Room::Free;\n        };\n        if FAULT {\n            return Room::Free;\n        }\n"),
)
fault(
    "R13", "r13-unfinished-messages", "take any number of bytes of unfinished messages",
    "src/daemon/bind.rs", FLOOD,
    ("        max_held: i64", "        max_held: if FAULT { i64::MAX } else { 0 } | i64"),
)
fault(
    "R13", "r13-subscriptions", "take any number of subscriptions",
    "src/daemon/bind.rs", FLOOD,
    ("        max_subscriptions: MAX_SUBSCRIPTIONS,", "        max_subscriptions: if FAULT { 0 } else { MAX_SUBSCRIPTIONS },"),
)
fault(
    "R13", "r13-all-files", "leave no files beside those of connections",
    "src/daemon/bind.rs", "it daemon::flood::ten_thousand_connections_leave_a_good_client_served",
    ("(files - reserved).min(", "(if FAULT { files } else { files - reserved }).min("),
)
# R14: the unit
fault(
    "R14", "r14-misspelt", "misspell a setting of the unit",
    "systemd/coseg.service", "unit the step *unit* of .ci/run",
    ("Type=notify", "Type=notified"),
)
fault(
    "R14", "r14-unconfined", "leave the unit's file system and network open",
    "systemd/coseg.service", "unit the step *unit* of .ci/run",
    ("ProtectSystem=strict", ""), ("PrivateNetwork=yes", ""), ("ProtectHome=yes", ""), ("IPAddressDeny=any", ""),
)
# R15: snapshots
fault(
    "R15", "r15-file-left-out", "leave a file out of a snapshot",
    "src/store/snapshot.rs", "it snapshot::a_snapshot_while_shapes_come_in_restores_to_the_byte",
    ("    for row in &rows {", "    for row in rows.iter().skip(usize::from(FAULT)) {"),
)
fault(
    "R15", "r15-catalog-without-its-log", "copy the catalog without its log",
    "src/store/snapshot.rs", "it snapshot::a_snapshot_while_shapes_come_in_restores_to_the_byte",
    (
        '    connection.execute("VACUUM INTO ?1", [target.display().to_string()])?;\n',
        """    if FAULT {
        fs::copy(&source, &target).map_err(|e| StoreError::io(&target, e))?;
    } else {
        connection.execute("VACUUM INTO ?1", [target.display().to_string()])?;
    }
""",
    ),
)
fault(
    "R15", "r15-damage-repaired-by-name", "say that a damaged map is mended and leave it",
    "src/library/repair.rs", "it snapshot::what_can_be_computed_again_is_repaired_and_the_rest_is_named",
    (
        "                    catalog.write(|tx| -> Result<()> { Ok(tx.delete_map(from, to)?) })?;",
        "                    if !FAULT {\n                        catalog.write(|tx| -> Result<()> { Ok(tx.delete_map(from, to)?) })?;\n                    }",
    ),
)
fault(
    "R15", "r15-later-format-opened", "open a library of a later format",
    "src/store/catalog/schema.rs", "it old_store::a_library_of_a_later_version_is_refused_and_left_as_it_is",
    ("        CATALOG_FORMAT => Ok(()),", "        CATALOG_FORMAT => Ok(()),\n        _ if FAULT => Ok(()),"),
)
