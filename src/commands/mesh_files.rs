//! Selects the files that `coseg add` sends, and their shape names.

use super::CommandError;
use coseg::library::check_shape_name;
use coseg::mesh::Format;
use std::collections::{HashMap, HashSet};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// Replaces the `/` of a path below the named folder in a shape's name.
const JOIN: &str = "__";
/// Maximum number of entries of subfolders that are examined for a note only.
const MOST_LOOKED_AT: usize = 10_000;
/// Extensions of files that commonly lie beside meshes and are skipped silently.
const BESIDE_MESHES: [&str; 19] = [
    "txt", "md", "mtl", "png", "jpg", "jpeg", "bmp", "tga", "json", "csv", "yaml", "yml", "seg",
    "npy", "npz", "html", "bin", "webp", "ktx2",
];

/// A mesh file to send.
#[derive(Debug, PartialEq)]
pub(super) struct MeshFile {
    pub(super) path: PathBuf,
    pub(super) name: String,
    pub(super) format: Format,
}

/// The files to send, in order, and the paths that cannot be sent.
#[derive(Debug, Default)]
pub(super) struct Found {
    pub(super) files: Vec<MeshFile>,
    /// Paths with the reasons.
    pub(super) refused: Vec<(PathBuf, String)>,
    /// Notes about skipped entries, which are not failures.
    pub(super) notes: Vec<String>,
}

/// Finds the files to send: named files as they are, and those of a folder in natural order; with
/// `recursive` also those of its subfolders.
///
/// A shape takes the name of its file without the extension; with `recursive` that of its path
/// below the folder, with `__` for each `/`. Of two files of one name the first is sent.
pub(super) fn find(paths: &[PathBuf], recursive: bool) -> Result<Found, CommandError> {
    let mut search = Search {
        found: Found::default(),
        recursive,
        entered: HashSet::new(),
    };
    for path in paths {
        if path.is_dir() {
            search.named_folder(path)?;
        } else if !path.exists() {
            let text = format!("{} does not exist", path.display());
            return Err(CommandError::Usage(text));
        } else {
            let name = path.file_name().unwrap_or_default();
            if Format::from_name(&name.to_string_lossy()).is_none() {
                let (path, known) = (path.display(), Format::EXTENSIONS);
                let text = format!("{path} is not a mesh file ({known})");
                return Err(CommandError::Usage(text));
            }
            search.file(path, &[]);
        }
    }
    Ok(search.found.without_clashes())
}

impl Found {
    fn without_clashes(mut self) -> Self {
        let mut first: HashMap<String, PathBuf> = HashMap::new();
        let mut kept = Vec::with_capacity(self.files.len());
        for file in self.files {
            match first.get(&file.name) {
                Some(other) => {
                    let why = format!(
                        "would be named {:?}, as {} is, which comes first; rename one of them",
                        file.name,
                        other.display()
                    );
                    self.refused.push((file.path, why));
                }
                None => {
                    first.insert(file.name.clone(), file.path.clone());
                    kept.push(file);
                }
            }
        }
        self.files = kept;
        self
    }
}

struct Search {
    found: Found,
    recursive: bool,
    /// Folders by device and inode: links may form cycles.
    entered: HashSet<(u64, u64)>,
}

impl Search {
    /// Enters a named folder, which must have files to send.
    fn named_folder(&mut self, path: &Path) -> Result<(), CommandError> {
        let before = self.found.files.len() + self.found.refused.len();
        self.folder(path, &mut Vec::new())?;
        let is_empty = self.found.files.len() + self.found.refused.len() == before;
        let below = match self.recursive {
            true => None,
            false => a_mesh_below(path),
        };
        let (path, known) = (path.display(), Format::EXTENSIONS);
        match below {
            Some(mesh) if is_empty => Err(CommandError::Usage(format!(
                "{path} itself has no mesh files ({known}), but its subfolders have, such as {}: \
                 add --recursive",
                mesh.display()
            ))),
            None if is_empty => {
                let text = format!("{path} has no mesh files ({known})");
                Err(CommandError::Usage(text))
            }
            Some(mesh) => {
                self.found.notes.push(format!(
                    "subfolders of {path} have meshes too, such as {}: --recursive adds them",
                    mesh.display()
                ));
                Ok(())
            }
            None => Ok(()),
        }
    }

    fn folder(&mut self, path: &Path, within: &mut Vec<String>) -> Result<(), CommandError> {
        let at = |source| CommandError::File {
            path: path.display().to_string(),
            source,
        };
        let metadata = std::fs::metadata(path).map_err(at)?;
        if !self.entered.insert((metadata.dev(), metadata.ino())) {
            return Ok(());
        }
        let mut entries: Vec<(String, PathBuf)> = Vec::new();
        for entry in std::fs::read_dir(path).map_err(at)? {
            let entry = entry.map_err(at)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if !name.starts_with('.') {
                entries.push((name, entry.path()));
            }
        }
        // Sorted by bytes first, since natural order alone does not distinguish `a01` from `a1`.
        entries.sort();
        entries.sort_by(|a, b| natord::compare(&a.0, &b.0));
        for (name, path) in entries {
            if path.is_dir() {
                if self.recursive {
                    within.push(name);
                    // One unreadable folder does not keep the others from being added.
                    if let Err(e) = self.folder(&path, within) {
                        self.found.refused.push((path, e.to_string()));
                    }
                    within.pop();
                }
            } else if Format::from_name(&name).is_some() {
                self.file(&path, within);
            } else if !is_beside_meshes(&name) {
                let known = Format::EXTENSIONS;
                let name = printable(&path);
                let note = format!("{name} is skipped, it is not a mesh file ({known})");
                self.found.notes.push(note);
            }
        }
        Ok(())
    }

    /// Adds a file whose extension marks it as a mesh; `within` are its folders below the named
    /// one.
    fn file(&mut self, path: &Path, within: &[String]) {
        let name = path.file_name().unwrap_or_default();
        let format = Format::from_name(&name.to_string_lossy());
        let stem = path.file_stem().and_then(|s| s.to_str());
        let (Some(format), Some(stem), true) = (format, stem, path.to_str().is_some()) else {
            let why = "its name is not valid UTF-8".to_owned();
            self.found.refused.push((path.to_owned(), why));
            return;
        };
        let folders = within.iter().map(String::as_str);
        let name = folders.chain([stem]).collect::<Vec<_>>().join(JOIN);
        match check_shape_name(&name) {
            Ok(()) => self.found.files.push(MeshFile {
                path: path.to_owned(),
                name,
                format,
            }),
            Err(e) => self.found.refused.push((path.to_owned(), e.to_string())),
        }
    }
}

/// A path on one line, whatever characters its name has.
pub(super) fn printable(path: &Path) -> String {
    let text = path.to_string_lossy();
    text.chars()
        .flat_map(|c| match c.is_control() {
            true => c.escape_default().collect::<Vec<_>>(),
            false => vec![c],
        })
        .collect()
}

/// A mesh file in a subfolder, if there is one among the first entries.
fn a_mesh_below(path: &Path) -> Option<PathBuf> {
    let mut folders = vec![path.to_owned()];
    let mut n = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            n += 1;
            if n > MOST_LOOKED_AT {
                return None;
            }
            let (name, kind) = (entry.file_name(), entry.file_type());
            let name = name.to_string_lossy();
            if name.starts_with('.') {
                continue;
            }
            // Links are not followed, since the result serves a note only.
            if kind.is_ok_and(|k| k.is_dir()) {
                folders.push(entry.path());
            } else if folder != path && Format::from_name(&name).is_some() {
                return Some(entry.path());
            }
        }
    }
    None
}

fn is_beside_meshes(name: &str) -> bool {
    let extension = name.rsplit_once('.').map(|(_, e)| e.to_ascii_lowercase());
    extension.is_none_or(|e| BESIDE_MESHES.contains(&e.as_str()))
}

#[cfg(test)]
mod tests {
    use super::{CommandError, Found, find, printable};
    use std::path::{Path, PathBuf};

    fn write(folder: &Path, names: &[&str]) {
        for name in names {
            let path = folder.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        }
    }

    fn names(found: &Found) -> Vec<&str> {
        found.files.iter().map(|f| f.name.as_str()).collect()
    }

    fn refused(found: &Found) -> Vec<(String, &str)> {
        let refused = found.refused.iter();
        refused
            .map(|(p, why)| {
                let name = p.file_name().unwrap().to_str().unwrap();
                (name.to_owned(), why.as_str())
            })
            .collect()
    }

    #[test]
    fn a_folder_is_read_in_natural_order_and_other_files_are_skipped() {
        let folder = tempfile::tempdir().unwrap();
        write(
            folder.path(),
            &[
                "10.off",
                "9.OBJ",
                "9.labels.txt",
                "11.Glb",
                "12.gltf",
                "13.stl",
                "14.PLY",
                "1.off",
                "x.step",
                ".hidden.off",
                "readme",
            ],
        );
        let found = find(&[folder.path().to_owned()], false).unwrap();
        assert_eq!(names(&found), ["1", "9", "10", "11", "12", "13", "14"]);
        assert!(found.refused.is_empty());
        assert_eq!(found.notes.len(), 1, "{:?}", found.notes);
        assert!(found.notes[0].contains("x.step is skipped"));
    }

    #[test]
    fn argument_order_is_kept_and_what_is_no_mesh_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), &["b.off", "a.obj", "c.txt"]);
        let path = |name: &str| folder.path().join(name);
        let found = find(&[path("b.off"), path("a.obj")], false).unwrap();
        assert_eq!(names(&found), ["b", "a"]);
        for wrong in ["c.txt", "none.off"] {
            let paths = [path("b.off"), path(wrong)];
            assert!(
                matches!(find(&paths, false), Err(CommandError::Usage(_))),
                "{wrong}"
            );
        }
    }

    #[test]
    fn bad_and_double_names_are_left_out_and_the_rest_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let long = format!("{}.off", "x".repeat(250));
        write(
            folder.path(),
            &["a.obj", "a.off", "b\nc.off", "d\te.ply", "f.stl", &long],
        );
        #[cfg(target_os = "linux")]
        {
            use std::os::unix::ffi::OsStrExt as _;
            let name = std::ffi::OsStr::from_bytes(b"\xff.off");
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let found = find(&[folder.path().to_owned()], false).unwrap();
        assert_eq!(names(&found), ["a", "f", &"x".repeat(250)]);
        assert_eq!(found.refused.len(), 4, "{:?}", found.refused);
        let of = |name: &str| {
            let all = found.refused.iter();
            let mut of = all.filter(|(p, _)| p.to_string_lossy().ends_with(name));
            of.next().map(|(_, why)| why.as_str()).unwrap_or_default()
        };
        assert!(of("b\nc.off").contains("'\\n'"), "{}", of("b\nc.off"));
        assert!(of("d\te.ply").contains("'\\t'"), "{}", of("d\te.ply"));
        assert!(
            of("a.off").contains("would be named \"a\", as "),
            "{}",
            of("a.off")
        );
        assert_eq!(printable(&PathBuf::from("b\nc\t.off")), "b\\nc\\t.off");
    }

    #[test]
    fn subfolders_are_named_or_searched() {
        let folder = tempfile::tempdir().unwrap();
        write(
            folder.path(),
            &[
                "top/a/1.off",
                "top/b/1.off",
                "top/b/deep/2.ply",
                "top/a__1.obj",
                "only/x/3.off",
            ],
        );
        std::os::unix::fs::symlink(folder.path().join("top"), folder.path().join("top/b/loop"))
            .unwrap();
        let path = |name: &str| folder.path().join(name);
        let found = find(&[path("top")], false).unwrap();
        assert_eq!(names(&found), ["a__1"]);
        assert!(
            found.notes[0].contains("--recursive adds them"),
            "{:?}",
            found.notes
        );
        let Err(CommandError::Usage(message)) = find(&[path("only")], false) else {
            panic!("a folder without meshes of its own is refused");
        };
        assert!(message.contains("x/3.off: add --recursive"), "{message}");
        let found = find(&[path("top")], true).unwrap();
        assert_eq!(names(&found), ["a__1", "b__1", "b__deep__2"]);
        assert_eq!(refused(&found).len(), 1);
        assert_eq!(refused(&found)[0].0, "a__1.obj");
        assert_eq!(names(&find(&[path("only")], true).unwrap()), ["x__3"]);
    }
}
