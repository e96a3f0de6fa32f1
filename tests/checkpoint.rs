//! Checkpoints against everything that happens to files: truncation, flipped bits, full disks, and the process dying while it saves.

use neurodin::config::Config;
use neurodin::scene::{Region, RegionShape};
use neurodin::train::checkpoint::{self, Checkpoint, PIECE, State, Tensor};
use neurodin::{Error, Result};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

fn state(step: u64) -> State {
    State {
        step,
        config: Config::preset("outdoor-tiny").unwrap(),
        region: Region {
            center: glam::DVec3::new(0.1, -2.5, 1e-30),
            radius: 2.25,
            shape: RegionShape::Sphere,
            how: "by hand".into(),
        },
        extra: BTreeMap::from([("views".to_string(), "a.png\nb\u{fc}.png".to_string())]),
    }
}

fn tensors() -> Vec<Tensor> {
    let tensor = |name: &str, shape: &[u64]| Tensor {
        name: name.into(),
        shape: shape.to_vec(),
    };
    vec![
        tensor("surface.table", &[1000, 2]),
        tensor("empty", &[0, 3]),
        tensor("moment", &[]),
    ]
}

/// Element `index` of a tensor at a step: all different, all exact.
fn element(tensor: &Tensor, step: u64, index: u64) -> f32 {
    (tensor.name.len() as u64 * 1_000_000 + step * 4_000 + index) as f32
}

fn save(folder: &Path, step: u64, tensors: &[Tensor]) -> Result<PathBuf> {
    checkpoint::save(folder, 2, &state(step), tensors, &mut |tensor,
                                                             range: Range<
        u64,
    >| {
        Ok(range.map(|index| element(tensor, step, index)).collect())
    })
}

/// Every element is what was saved.
fn verify(checkpoint: &Checkpoint, tensors: &[Tensor]) {
    let step = checkpoint.state().step;
    assert_eq!(checkpoint.state(), &state(step));
    assert_eq!(checkpoint.tensors(), tensors);
    for tensor in tensors {
        let (shape, numbers) = checkpoint.tensor(&tensor.name).unwrap();
        assert_eq!(shape, tensor.shape);
        assert_eq!(numbers.len() as u64, tensor.len());
        for (index, number) in numbers.iter().enumerate() {
            assert_eq!(
                *number,
                element(tensor, step, index as u64),
                "{} [{index}]",
                tensor.name
            );
        }
    }
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

#[test]
fn round_trip_keeps_everything_and_the_newest_two() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path().join("ckpt");
    for step in [0, 10, 20, 30] {
        save(&folder, step, &tensors()).unwrap();
    }
    assert_eq!(
        names(&folder),
        ["step-00000020.safetensors", "step-00000030.safetensors"]
    );
    let latest = checkpoint::latest(&folder).unwrap();
    assert!(latest.refused.is_empty());
    assert_eq!(latest.checkpoint.state().step, 30);
    verify(&latest.checkpoint, &tensors());

    let bytes = fs::read(latest.checkpoint.path()).unwrap();
    let others = safetensors::SafeTensors::deserialize(&bytes).expect("other readers accept it");
    assert_eq!(others.tensor("surface.table").unwrap().shape(), [1000, 2]);

    save(&folder, 30, &tensors()).unwrap();
    assert_eq!(
        fs::read(latest.checkpoint.path()).unwrap(),
        bytes,
        "the same state, the same bytes"
    );
}

/// A tensor that takes several pieces, the last one short.
#[test]
fn large_tensors_pass_in_pieces() {
    let folder = tempfile::tempdir().unwrap();
    let tensor = Tensor {
        name: "table".into(),
        shape: vec![2 * PIECE + 5],
    };
    let mut asked = Vec::new();
    let value = |index: u64| (index % 8_388_608) as f32;
    let path = checkpoint::save(
        folder.path(),
        2,
        &state(7),
        std::slice::from_ref(&tensor),
        &mut |_, range| {
            asked.push(range.clone());
            Ok(range.map(value).collect())
        },
    )
    .unwrap();
    assert_eq!(
        asked,
        [0..PIECE, PIECE..2 * PIECE, 2 * PIECE..2 * PIECE + 5]
    );
    let mut next = 0;
    Checkpoint::open(&path)
        .unwrap()
        .read(&tensor, &mut |first, numbers| {
            assert_eq!(first, next);
            next += numbers.len() as u64;
            for (offset, number) in numbers.iter().enumerate() {
                assert_eq!(*number, value(first + offset as u64));
            }
            Ok(())
        })
        .unwrap();
    assert_eq!(next, tensor.len());
}

/// The error, which must be about the file and say what comes next.
fn refusal(path: &Path) -> String {
    match Checkpoint::open(path) {
        Err(Error::Input {
            path: named,
            what,
            next,
        }) => {
            assert_eq!(named, path);
            assert!(!next.is_empty());
            what
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn truncated_files_are_refused_and_the_previous_one_is_offered() {
    let folder = tempfile::tempdir().unwrap();
    save(folder.path(), 10, &tensors()).unwrap();
    let path = save(folder.path(), 20, &tensors()).unwrap();
    let whole = fs::read(&path).unwrap();
    let header = 8 + u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    let checksums = whole.len() - 5 * 4;
    let mut lengths: Vec<usize> = (0..16).collect();
    lengths.extend([
        header / 2,
        header - 1,
        header,
        header + 1,
        header + 4000,
        header + 8000,
        header + 8004,
    ]);
    lengths.extend(checksums - 1..whole.len());
    lengths.extend((0..whole.len()).step_by(97));
    for length in lengths {
        fs::write(&path, &whole[..length]).unwrap();
        let what = refusal(&path);
        assert!(
            what.contains("damaged checkpoint"),
            "{length} bytes: {what}"
        );
        let latest = checkpoint::latest(folder.path()).unwrap();
        assert_eq!(latest.checkpoint.state().step, 10);
        assert_eq!(latest.refused.len(), 1);
        verify(&latest.checkpoint, &tensors());
    }
    fs::write(&path, [&whole[..], &[0]].concat()).unwrap();
    assert!(refusal(&path).contains("promises"), "a byte too many");

    fs::write(folder.path().join("step-00000010.safetensors"), b"{}").unwrap();
    let error = checkpoint::latest(folder.path()).unwrap_err().to_string();
    assert!(
        error.contains("step-00000010") && error.contains("step-00000020"),
        "{error}"
    );
}

#[test]
fn flipped_bits_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = save(folder.path(), 20, &tensors()).unwrap();
    let mut bytes = fs::read(&path).unwrap();
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let everywhere = (0..64)
        .chain((64..8 * header).step_by(13))
        .chain((8 * header..8 * bytes.len()).step_by(131));
    let checksums = 8 * (bytes.len() - 20)..8 * bytes.len();
    for bit in everywhere.chain(checksums) {
        bytes[bit / 8] ^= 1 << (bit % 8);
        fs::write(&path, &bytes).unwrap();
        refusal(&path);
        bytes[bit / 8] ^= 1 << (bit % 8);
    }
    // One of a tensor is told by its name.
    bytes[header + 5] ^= 4;
    fs::write(&path, &bytes).unwrap();
    let what = refusal(&path);
    assert!(
        what.contains("surface.table") && what.contains("checksum"),
        "{what}"
    );
}

proptest! {
    /// Nothing that a file can hold makes the reader panic or believe it.
    #[test]
    fn arbitrary_files_are_refused(
        length in prop_oneof![Just(None), any::<u64>().prop_map(Some)],
        text in prop_oneof![
            ".{0,200}",
            r#"\{"a":\{"dtype":"F32","shape":\[[0-9]{1,20}(,[0-9]{1,20})?\],"data_offsets":\[0,[0-9]{1,20}\]\},"checksums":\{"dtype":"U32","shape":\[3\],"data_offsets":\[[0-9]{1,20},[0-9]{1,20}\]\}\}"#,
        ],
        data in proptest::collection::vec(any::<u8>(), 0..64),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("step-00000001.safetensors");
        let length = length.unwrap_or(text.len() as u64);
        fs::write(&path, [&length.to_le_bytes()[..], text.as_bytes(), &data].concat()).unwrap();
        refusal(&path);
    }
}

#[test]
fn what_is_no_checkpoint_of_ours_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("step-00000005.safetensors");
    let alien = safetensors::serialize(
        [(
            "x",
            safetensors::tensor::TensorView::new(safetensors::Dtype::U8, vec![3], &[1, 2, 3])
                .unwrap(),
        )],
        None,
    );
    fs::write(&path, alien.unwrap()).unwrap();
    assert!(refusal(&path).contains("not a checkpoint of neurodin"));
    let missing = folder.path().join("nowhere");
    let error = checkpoint::latest(&missing).unwrap_err().to_string();
    assert!(error.contains("no checkpoint"), "{error}");

    save(folder.path(), 5, &tensors()).unwrap();
    let checkpoint = Checkpoint::open(&path).unwrap();
    let mut wrong = tensors()[0].clone();
    wrong.shape = vec![2000];
    let error = checkpoint
        .read(&wrong, &mut |_, _| Ok(()))
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("[1000, 2]") && error.contains("[2000]"),
        "{error}"
    );
    assert!(
        checkpoint
            .tensor("absent")
            .unwrap_err()
            .to_string()
            .contains("'absent'")
    );
}

/// A device that fills up, played by /dev/full under the temporary file's name.
#[test]
#[cfg(target_os = "linux")]
fn a_full_disk_is_reported_and_costs_nothing() {
    let folder = tempfile::tempdir().unwrap();
    save(folder.path(), 10, &tensors()).unwrap();
    let part = format!("step-00000020.safetensors.{}.part", std::process::id());
    let part = folder.path().join(part);
    std::os::unix::fs::symlink("/dev/full", &part).unwrap();
    match save(folder.path(), 20, &tensors()) {
        Err(error @ Error::Output { .. }) => {
            assert_eq!(error.exit_code(), 8);
            let text = error.to_string();
            for part in [
                "step-00000020",
                "No space left",
                "step 10 is intact",
                "--resume",
            ] {
                assert!(text.contains(part), "{text}");
            }
        }
        other => panic!("{other:?}"),
    }
    assert_eq!(
        names(folder.path()),
        ["step-00000010.safetensors"],
        "nothing half-written stays"
    );
    verify(
        &checkpoint::latest(folder.path()).unwrap().checkpoint,
        &tensors(),
    );
}

#[test]
fn a_failing_device_leaves_the_previous_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    save(folder.path(), 10, &tensors()).unwrap();
    let lost = checkpoint::save(folder.path(), 1, &state(20), &tensors(), &mut |_, _| {
        Err(Error::DeviceLost {
            what: "gone".into(),
        })
    });
    assert!(matches!(lost, Err(Error::DeviceLost { .. })), "{lost:?}");
    assert_eq!(names(folder.path()), ["step-00000010.safetensors"]);
}

/// A refused later checkpoint gives way as soon as a new one is complete, and never to the new one's cost.
#[test]
fn the_newly_written_one_is_never_removed() {
    let folder = tempfile::tempdir().unwrap();
    for step in [10, 20] {
        save(folder.path(), step, &tensors()).unwrap();
    }
    fs::write(folder.path().join("step-00000020.safetensors"), b"damaged").unwrap();
    let path = checkpoint::save(
        folder.path(),
        1,
        &state(15),
        &[],
        &mut |_, _| Ok(Vec::new()),
    )
    .unwrap();
    assert_eq!(names(folder.path()), ["step-00000015.safetensors"]);
    assert_eq!(Checkpoint::open(&path).unwrap().state().step, 15);
}

const KILLED: &str = "NEURODIN_TEST_CHECKPOINTS";

/// Saves until the process is killed.
fn save_for_ever(folder: &Path) -> ! {
    let newest = checkpoint::files(folder).unwrap().pop();
    let mut step = newest.map_or(0, |(step, _)| step);
    loop {
        step += 1;
        save(folder, step, &tensors()).unwrap();
    }
}

/// This test program. Under a private Mesa's launcher the running image is a loader, so the name it was called by counts.
fn itself() -> std::process::Command {
    let program = std::env::args_os().next().unwrap();
    match std::env::var_os("NEURODIN_LAUNCHER") {
        Some(launcher) => {
            let mut command = std::process::Command::new(launcher);
            command.arg(program);
            command
        }
        None => std::process::Command::new(program),
    }
}

/// SIGKILL at any moment of saving leaves a whole checkpoint, no older than the newest one known.
#[test]
#[cfg(unix)]
fn killing_never_costs_the_checkpoint() {
    // The process to be killed is this test once more.
    if let Some(folder) = std::env::var_os(KILLED) {
        save_for_ever(Path::new(&folder));
    }
    let folder = tempfile::tempdir().unwrap();
    save(folder.path(), 1, &tensors()).unwrap();
    let mut newest = 1;
    let mut died_saving = 0;
    for round in 0..100u64 {
        let mut child = itself()
            .args(["--exact", "killing_never_costs_the_checkpoint"])
            .env(KILLED, folder.path())
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        // It has begun when something newer is there; the moment of death then spreads over a few saves.
        let deadline = Instant::now() + Duration::from_secs(60);
        while checkpoint::files(folder.path()).unwrap().last().unwrap().0 <= newest {
            assert!(
                Instant::now() < deadline,
                "the child never saved in round {round}"
            );
            std::thread::sleep(Duration::from_micros(200));
        }
        std::thread::sleep(Duration::from_micros((round * 7_919) % 5_000));
        child.kill().unwrap();
        let ended = child.wait().unwrap();
        assert_eq!(ended.code(), None, "it was still saving in round {round}");
        died_saving += u32::from(
            names(folder.path())
                .iter()
                .any(|name| name.ends_with(".part")),
        );
        let latest = checkpoint::latest(folder.path()).unwrap();
        assert!(latest.refused.is_empty(), "{:?}", latest.refused);
        assert!(latest.checkpoint.state().step >= newest);
        newest = latest.checkpoint.state().step;
        verify(&latest.checkpoint, &tensors());
    }
    assert!(died_saving > 5, "some died in the middle: {died_saving}");
}
