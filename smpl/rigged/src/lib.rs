//! Rigged characters from glTF 2.0 ([`Character`]), and triangle meshes from files ([`load_mesh`]).
//!
//! ```
//! // One triangle without a skin: it follows its node, 1 m up.
//! let gltf = r#"{"asset": {"version": "2.0"},
//!     "nodes": [{"mesh": 0, "translation": [0, 1, 0]}],
//!     "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
//!     "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3",
//!                    "min": [0, 0, 0], "max": [1, 1, 0]}],
//!     "bufferViews": [{"buffer": 0, "byteLength": 36}],
//!     "buffers": [{"byteLength": 36, "uri":
//!         "data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"}]}"#;
//! let character = rigged::Character::from_bytes("triangle.gltf", gltf.as_bytes()).unwrap();
//! assert_eq!((character.num_joints(), character.faces.len()), (1, 1));
//! assert_eq!(character.rest().vertices[1], glam::Vec3::new(1.0, 1.0, 0.0));
//! ```
//!
//! Damaged and hostile files are errors that name the part of the document: every index and range
//! is checked before it is used, a document may decode to 256 MiB and read 512 MiB of other files,
//! none of them outside its folder. Metres, y up, as in glTF.

mod accessor;
mod character;
mod mesh;
mod read;

/// The README's example, compiled as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use character::{Animation, Character, CharacterPose, Texture};
pub use mesh::{Mesh, load_mesh};
